"""Transforms against formulae of their own, and against what the conventions say."""

import numpy as np
import pytest

from wavefront.errors import SceneError
from wavefront.scene.description import LookAt, Rotate, TransformStep
from wavefront.scene.transforms import check_affine, is_mirror, to_matrix


def test_empty_transform_is_identity():
    np.testing.assert_array_equal(to_matrix([]), np.eye(4))


def test_rows_are_kept_as_they_are():
    rows = [(1.0, 2.0, 3.0, 4.0), (0.0, 1.0, 5.0, 6.0), (0.0, 0.0, 2.0, 7.0), (0.0, 0.0, 0.0, 1.0)]
    matrix = to_matrix(rows)
    assert matrix.dtype == np.float64
    np.testing.assert_array_equal(matrix, rows)


def test_first_step_is_applied_first():
    steps = [TransformStep(scale=2.0), TransformStep(translate=(1.0, 0.0, 0.0))]
    np.testing.assert_allclose(to_matrix(steps) @ (1.0, 1.0, 1.0, 1.0), (3.0, 2.0, 2.0, 1.0))
    np.testing.assert_allclose(to_matrix(steps[::-1]) @ (1.0, 1.0, 1.0, 1.0), (4.0, 2.0, 2.0, 1.0))


def test_rotation_is_counter_clockwise_against_the_axis():
    matrix = to_matrix([TransformStep(rotate=Rotate(axis=(0.0, 0.0, 5.0), angle=90.0))])
    np.testing.assert_allclose(matrix @ (1.0, 0.0, 0.0, 1.0), (0.0, 1.0, 0.0, 1.0), atol=1e-15)


def test_rotation_keeps_lengths_and_its_axis():
    axis = np.array((1.0, -2.0, 0.5))
    matrix = to_matrix([TransformStep(rotate=Rotate(axis=tuple(axis), angle=37.0))])[:3, :3]
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(matrix @ axis, axis, atol=1e-14)
    assert np.trace(matrix) == pytest.approx(1.0 + 2.0 * np.cos(np.radians(37.0)))


def test_look_at_frame():
    origin, target, up = np.array((1.0, 2.0, 3.0)), np.array((-4.0, 0.5, 9.0)), np.array((0.1, 1.0, -0.2))
    step = TransformStep(look_at=LookAt(origin=tuple(origin), target=tuple(target), up=tuple(up)))
    matrix = to_matrix([step])
    forward = (target - origin) / np.linalg.norm(target - origin)
    np.testing.assert_allclose(matrix[:3, 3], origin)
    np.testing.assert_allclose(-matrix[:3, 2], forward, atol=1e-15)
    np.testing.assert_allclose(matrix[:3, :3].T @ matrix[:3, :3], np.eye(3), atol=1e-14)
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    assert matrix[:3, 1] @ up > 0.0
    assert matrix[:3, 0] @ up == pytest.approx(0.0, abs=1e-15)
    # the viewer's right hand: forward x up
    np.testing.assert_allclose(matrix[:3, 0], np.cross(forward, matrix[:3, 1]), atol=1e-14)


def test_mirror():
    assert is_mirror(to_matrix([TransformStep(scale=(-1.0, 1.0, 1.0))]))
    assert not is_mirror(to_matrix([TransformStep(scale=(-1.0, -1.0, 1.0))]))


@pytest.mark.parametrize("size", [1e-8, 1e8])
def test_extreme_scales_are_invertible(size):
    assert to_matrix([TransformStep(scale=size)])[0, 0] == size


@pytest.mark.parametrize(
    ("transform", "words"),
    [
        ([TransformStep()], "t[0]: a transform step has exactly one of"),
        ([TransformStep(scale=1.0, translate=(0.0, 0.0, 0.0))], "found translate and scale"),
        ([TransformStep(scale=0.0)], "not invertible"),
        ([TransformStep(scale=(1.0, 0.0, 1.0))], "not invertible"),
        ([TransformStep(scale=float("nan"))], "not finite"),
        ([TransformStep(translate=(float("inf"), 0.0, 0.0))], "not finite"),
        ([TransformStep(rotate=Rotate(axis=(0.0, 0.0, 0.0), angle=1.0))], "t[0].rotate: the rotation axis is zero"),
        ([TransformStep(look_at=LookAt(origin=(1.0, 1.0, 1.0), target=(1.0, 1.0, 1.0)))], "same point"),
        ([TransformStep(look_at=LookAt(origin=(0.0, 0.0, 0.0), target=(0.0, 3.0, 0.0)))], "parallel"),
        ([(1.0, 0.0, 0.0, 0.0)] * 3, "found 3 rows"),
        ([(1.0, 0.0, 0.0, 0.0), TransformStep(scale=1.0)], "cannot be mixed"),
        ([(1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 1.0, 1.0)], "last row"),
    ],
)
def test_errors(transform, words):
    with pytest.raises(SceneError) as caught:
        to_matrix(transform, "t")
    assert words in str(caught.value)
    assert str(caught.value).startswith("t")
    assert "\n" not in str(caught.value)


def test_check_affine_accepts_a_rigid_motion():
    check_affine(to_matrix([TransformStep(translate=(1.0, 2.0, 3.0))]))
