"""Runs inside the Python of Blender's module `bpy`: builds a scene from a folder and renders with Cycles when asked to.

    python cycles_child.py FOLDER

FOLDER is as `tools.peers.cycles_scene` writes it. Requests come on the standard input, one JSON object per line;
each gets one line of JSON on what was the standard output when the process began (Blender writes there too, which goes
to the standard error):

    {"width": w, "height": h, "seed": s, "offset": k, "samples": n, "guided": false, "image": path}

renders samples k to k + n - 1 of every pixel, writes their mean to an OpenEXR file, and answers {"seconds": t}. What
fails answers {"error": text}. The process ends with its standard input, or with the process that started it, and
removes FOLDER. This file imports nothing of the project, which need not be installed beside Blender.
"""

import json
import os
import shutil
import sys
import threading
import time
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix


def main(folder: Path) -> None:
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    begin = time.perf_counter()

    def answer(**values) -> None:
        answers.write(json.dumps(values) + "\n")
        answers.flush()

    try:
        build(json.loads((folder / "scene.json").read_text(encoding="utf-8")), folder)
    except Exception as error:  # whatever it is, the other process has to hear of it
        answer(error=f"{type(error).__name__}: {error}")
        return
    answer(version=bpy.app.version_string, seconds=time.perf_counter() - begin)
    for line in sys.stdin:
        try:
            answer(seconds=render(**json.loads(line)))
        except Exception as error:
            answer(error=f"{type(error).__name__}: {error}")


def end_with(parent: int, folder: str) -> None:
    """Ends this process, in the middle of a render too, when the one that started it is no more."""
    while os.getppid() == parent:
        time.sleep(1.0)
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


def render(width: int, height: int, seed: int, offset: int, samples: int, guided: bool, image: str) -> float:
    """Wall time in seconds."""
    scene = bpy.context.scene
    for target, name, value in (
        (scene.render, "resolution_x", width),
        (scene.render, "resolution_y", height),
        (scene.render, "filepath", image),
        (scene.cycles, "seed", seed),
        (scene.cycles, "use_guiding", guided),
        (scene.cycles, "sample_offset", offset),
        (scene.cycles, "sample_subset_length", samples),
    ):
        put(target, name, value)
    scene.update_tag()  # or what Cycles keeps of the scene keeps the samples of the render before
    begin = time.perf_counter()
    if bpy.ops.render.render(write_still=True) != {"FINISHED"}:
        raise RuntimeError("the render was cancelled")
    return time.perf_counter() - begin


def put(target, path: str, value) -> None:
    """Sets a property, unless it has the value already, and makes sure that it was taken."""
    *parents, name = path.split(".")
    for parent in parents:
        target = getattr(target, parent)
    if getattr(target, name) == value:
        return
    setattr(target, name, value)
    found = getattr(target, name)
    if found != value and not (isinstance(value, float) and np.float32(value) == np.float32(found)):
        raise ValueError(f"{path} = {value!r}: Blender made {found!r} of it")


# --- the scene ---------------------------------------------------------------------------------------------------


def build(description: dict, folder: Path) -> None:
    """Makes the description the current scene, and the only one."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    for path, value in description["settings"].items():
        put(scene, path, value)
    images = {name: load_image(folder / name) for name in description["images"]}
    materials = []
    for i, record in enumerate(description["materials"]):
        material = bpy.data.materials.new(f"material {i}")
        material.cycles.emission_sampling = record["sampling"]
        connect(material.node_tree, "ShaderNodeOutputMaterial", record["surface"], images)
        materials.append(material)
    meshes = []
    for i, record in enumerate(description["meshes"]):
        mesh = make_mesh(f"mesh {i}", folder / record["arrays"])
        mesh.materials.append(materials[record["material"]])
        meshes.append(mesh)
    for i, record in enumerate(description["objects"]):
        thing = bpy.data.objects.new(f"object {i}", meshes[record["mesh"]])
        # Anything but exact: it moves where light ends near the horizon of smooth surfaces.
        thing.shadow_terminator_geometry_offset = thing.shadow_terminator_shading_offset = 0.0
        scene.collection.objects.link(thing)
        if record["matrix"] is not None:
            place(thing, record["matrix"], scene)
    world = scene.world = bpy.data.worlds.new("world")
    if description["world"] is None:
        connect(world.node_tree, "ShaderNodeOutputWorld", None, images)
        world.cycles.sampling_method = "NONE"
    else:
        connect(world.node_tree, "ShaderNodeOutputWorld", description["world"]["surface"], images)
        world.cycles.sampling_method = description["world"]["sampling"]
        world.cycles.sample_map_resolution = description["world"]["resolution"]
    for i, record in enumerate(description["lights"]):
        light = bpy.data.lights.new(f"light {i}", record["type"])
        for name, value in record["properties"].items():
            put(light, name, value)
        connect(light.node_tree, "ShaderNodeOutputLight", record["surface"], images)
        thing = bpy.data.objects.new(f"light {i}", light)
        scene.collection.objects.link(thing)
        thing.matrix_world = Matrix(record["matrix"])
    record = description["camera"]
    camera = bpy.data.cameras.new("camera")
    for name, value in record["properties"].items():
        put(camera, name, value)
    scene.camera = bpy.data.objects.new("camera", camera)
    scene.collection.objects.link(scene.camera)
    scene.camera.matrix_world = Matrix(record["matrix"])


def place(thing, rows: list, scene) -> None:
    """Puts an object by any affine transform; its own location, rotation and scale could not hold a shear."""
    parent = bpy.data.objects.new("frame of " + thing.name, None)
    scene.collection.objects.link(parent)
    thing.parent = parent
    thing.matrix_parent_inverse = Matrix(rows)


def load_image(path: Path):
    """An image of linear values, taken as they are."""
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    image.alpha_mode = "NONE"
    return image


def make_mesh(name: str, path: Path):
    """Triangles from a file of arrays: vertices, faces, and where there are any, normals and uvs per vertex."""
    arrays = np.load(path)
    vertices, faces = arrays["vertices"], arrays["faces"]
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", vertices.ravel())
    mesh.loops.add(3 * len(faces))
    mesh.loops.foreach_set("vertex_index", faces.ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * len(faces), 3, dtype=np.int32))
    mesh.polygons.foreach_set("use_smooth", np.full(len(faces), "normals" in arrays))
    if "uvs" in arrays:
        layer = mesh.uv_layers.new(name="uv")
        layer.uv.foreach_set("vector", arrays["uvs"][faces.ravel()].ravel())
    mesh.update(calc_edges=True)
    if "normals" in arrays:  # as they are: Blender's own custom normals are of 16 bits
        attribute = mesh.attributes.new("custom_normal", "FLOAT_VECTOR", "POINT")
        attribute.data.foreach_set("vector", arrays["normals"].ravel())
    return mesh


# --- nodes -------------------------------------------------------------------------------------------------------


def connect(tree, output: str, surface: dict | None, images: dict) -> None:
    """Makes a tree of nodes from its description (see `cycles_scene.node`); None: black."""
    tree.nodes.clear()
    end = tree.nodes.new(output)
    if surface is not None:
        tree.links.new(make_node(tree, surface, images, {}), end.inputs["Surface"])


def make_node(tree, record: dict, images: dict, known: dict):
    """The output socket of a described node; equal descriptions in one tree are one node."""
    key = json.dumps(record, sort_keys=True)
    if key not in known:
        node = known[key] = tree.nodes.new(record["type"])
        for name, value in record["properties"].items():
            if name == "image":
                node.image = images[value]
            else:
                put(node, name, value)
        for name, value in record["inputs"].items():
            socket = socket_of(node.inputs, name)
            if isinstance(value, dict):
                tree.links.new(make_node(tree, value, images, known), socket)
            elif value is not None:
                rgba = socket.type == "RGBA"
                socket.default_value = [*value, 1.0] if rgba else value
                found = np.ravel(socket.default_value)[: np.size(value)]
                if not np.array_equal(found, np.asarray(value, np.float32).ravel()):
                    raise ValueError(f"{record['type']}: {name} = {value!r}: Blender made {found.tolist()!r} of it")
    return socket_of(known[key].outputs, record["output"])


def socket_of(sockets, identifier: str):
    found = [socket for socket in sockets if socket.identifier == identifier]
    if not found:
        raise KeyError(f"no socket {identifier!r}; there are {', '.join(s.identifier for s in sockets)}")
    return found[0]


if __name__ == "__main__":
    threading.Thread(target=end_with, args=(os.getppid(), sys.argv[1]), daemon=True).start()
    try:
        main(Path(sys.argv[1]))
    finally:
        shutil.rmtree(sys.argv[1], ignore_errors=True)
