"""The nodes of a glTF scene with their transforms (glTF 2.0, section 3.5)."""

from __future__ import annotations

import numpy as np

from wavefront.scene.gltf_document import Document, Node


def choose_scene(document: Document, scene: int | None = None) -> int | None:
    """Index of the scene to read: `scene`, or the file's own choice, or the first; None if there is none.

    Raises:
        SceneError: There is no such scene.
    """
    index, where = (document.root.scene, "scene") if scene is None else (scene, "scenes")
    if index is not None:
        document.item("scenes", index, where)
        return index
    return 0 if document.root.scenes else None


def world_nodes(document: Document, scene: int | None = None) -> list[tuple[int, np.ndarray]]:
    """The nodes of a scene in depth-first order, each with its (4, 4) float64 matrix to world space.

    Args:
        document: The file.
        scene: As `choose_scene` takes it. In a file without scenes, all nodes count that no other holds.

    Raises:
        SceneError: An index out of range, a node that two others hold or that holds itself, or a bad transform.
    """
    nodes, chosen = document.root.nodes, choose_scene(document, scene)
    parents: dict[int, str] = {}
    for i, node in enumerate(nodes):
        for j, child in enumerate(node.children):
            where = f"nodes[{i}].children[{j}]"
            document.item("nodes", child, where)
            if child in parents:
                raise document.error(where, f"node {child} has a parent already, {parents[child]}")
            parents[child] = where
    if chosen is None:
        roots = [(i, f"nodes[{i}]") for i in range(len(nodes)) if i not in parents]
    else:
        roots = [(i, f"scenes[{chosen}].nodes[{j}]") for j, i in enumerate(document.root.scenes[chosen].nodes)]
    found: list[tuple[int, np.ndarray]] = []
    seen: set[int] = set()
    stack = [(i, np.eye(4), where) for i, where in reversed(roots)]
    while stack:
        i, parent, where = stack.pop()
        node = document.item("nodes", i, where)
        if i in seen:  # as a root and as a child, or because it holds itself
            raise document.error(where, f"node {i} is reached twice")
        seen.add(i)
        with np.errstate(over="ignore", invalid="ignore"):
            matrix = parent @ local_matrix(document, i)
        if not np.isfinite(matrix).all():
            raise document.error(f"nodes[{i}]", "the transform overflows")
        found.append((i, matrix))
        stack.extend((child, matrix, f"nodes[{i}].children") for child in reversed(node.children))
    return found


def local_matrix(document: Document, index: int) -> np.ndarray:
    """(4, 4) float64 of a node: its matrix, or translation times rotation times scale.

    Raises:
        SceneError: A matrix that is not affine or given beside other parts, or a rotation of length zero.
    """
    node, where = document.root.nodes[index], f"nodes[{index}]"
    plain = Node()
    if node.matrix is not None:
        for part in ("translation", "rotation", "scale"):
            if getattr(node, part) != getattr(plain, part):
                raise document.error(where, f"a node has matrix, or translation, rotation and scale; found {part} too")
        matrix = np.array(node.matrix, np.float64).reshape(4, 4).T  # columns first
        if not np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0)):
            raise document.error(f"{where}.matrix", "the last row of a transform must be 0 0 0 1")
        return matrix
    matrix = np.eye(4)
    if node.rotation != plain.rotation:
        if not any(node.rotation):
            raise document.error(f"{where}.rotation", "the quaternion is zero")
        matrix[:3, :3] = rotation_matrix(node.rotation)
    matrix[:3, :3] *= np.array(node.scale)
    matrix[:3, 3] = node.translation
    return matrix


def rotation_matrix(quaternion) -> np.ndarray:
    """(3, 3) float64 of a quaternion (x, y, z, w) of any length but zero."""
    q = np.array(quaternion, np.float64)
    q /= np.abs(q).max()  # so that the length neither overflows nor vanishes
    x, y, z, w = q / np.linalg.norm(q)
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def is_flat(matrix: np.ndarray) -> bool:
    """Whether a transform flattens space, as a scale of 0 does, by which nodes are hidden (section 3.5.3)."""
    singular = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    return not singular[2] > 1e-12 * singular[0]
