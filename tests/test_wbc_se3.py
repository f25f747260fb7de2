"""SE(3) functions against SciPy's rotations in float64. Tolerance 2e-6: float32 with a few operations."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from wbm.kernels import se3

TOL = 2e-6


@wp.kernel
def _probe(
    a: wp.array(dtype=wp.vec4),
    b: wp.array(dtype=wp.vec4),
    v: wp.array(dtype=wp.vec3),
    vec4_out: wp.array2d(dtype=wp.vec4),
    vec3_out: wp.array2d(dtype=wp.vec3),
    mat_out: wp.array2d(dtype=wp.mat33),
):
    i = wp.tid()
    qa = se3.quat_wxyz_normalize(a[i])
    qb = se3.quat_wxyz_normalize(b[i])
    vec4_out[i, 0] = se3.quat_wxyz_mul(qa, qb)
    vec4_out[i, 1] = se3.quat_wxyz_exp(v[i])
    vec4_out[i, 2] = se3.mat_to_quat_wxyz(se3.quat_wxyz_to_mat(qa))
    vec3_out[i, 0] = se3.quat_wxyz_rotate(qa, v[i])
    vec3_out[i, 1] = se3.quat_wxyz_rotate_inv(qa, v[i])
    vec3_out[i, 2] = se3.quat_wxyz_log(qa)
    vec3_out[i, 3] = se3.rotation_error(qa, qb)
    vec3_out[i, 4] = se3.pose_inv_mul_pos(v[i], qb, -v[i])
    mat_out[i, 0] = se3.quat_wxyz_to_mat(qa)


def probe(a, b, v):
    n = len(a)
    arrays = [
        wp.array(np.asarray(x, np.float32), dtype=t, device="cpu")
        for x, t in ((a, wp.vec4), (b, wp.vec4), (v, wp.vec3))
    ]
    out = [
        wp.full((n, k), value=t(np.inf), dtype=t, device="cpu") for k, t in ((3, wp.vec4), (5, wp.vec3), (1, wp.mat33))
    ]
    wp.launch(_probe, dim=n, inputs=arrays, outputs=out, device="cpu")
    return [o.numpy().astype(np.float64) for o in out]


def to_rot(q):
    return Rotation.from_quat(np.asarray(q, np.float64), scalar_first=True)


def same_rotation(q, rot):
    return np.minimum(
        np.abs(q - rot.as_quat(scalar_first=True)).max(-1), np.abs(q + rot.as_quat(scalar_first=True)).max(-1)
    )


def test_against_scipy():
    rng = np.random.default_rng(0)
    a, b, v = rng.normal(size=(500, 4)), rng.normal(size=(500, 4)), rng.normal(size=(500, 3))
    a[0], a[1], a[2], a[3] = (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)
    b[4] = a[4]
    vec4, vec3, mat = probe(a, b, v)
    ra, rb = to_rot(a), to_rot(b)
    assert same_rotation(vec4[:, 0], ra * rb).max() < TOL
    assert same_rotation(vec4[:, 1], Rotation.from_rotvec(v)).max() < TOL
    assert same_rotation(vec4[:, 2], ra).max() < TOL
    assert np.abs(vec3[:, 0] - ra.apply(v)).max() < 2 * TOL
    assert np.abs(vec3[:, 1] - ra.inv().apply(v)).max() < 2 * TOL
    assert np.abs(Rotation.from_rotvec(vec3[:, 2]).as_matrix() - ra.as_matrix()).max() < 2 * TOL
    assert np.abs((Rotation.from_rotvec(vec3[:, 3]) * rb).as_matrix() - ra.as_matrix()).max() < 4 * TOL
    assert np.abs(vec3[:, 4] - rb.inv().apply(-2 * v)).max() < 4 * TOL
    assert np.abs(mat[:, 0] - ra.as_matrix()).max() < TOL
    assert np.linalg.norm(vec3[:, 2], axis=-1).max() <= np.pi + TOL


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=8, max_size=8))
def test_never_nan_for_finite_quaternions(x):
    vec4, vec3, mat = probe([x[:4]], [x[4:]], [[0.0, 0.0, 0.0]])
    for out in (vec4, vec3, mat):
        assert np.isfinite(out).all()


@pytest.mark.parametrize("angle", [1e-8, 1e-5, 1e-3, 1e-2, 1.0, np.pi - 1e-4])
def test_exp_log_round_trip(angle):
    v = np.array([[0.6, -0.8, 0.0]]) * angle
    vec4, _, _ = probe([[1, 0, 0, 0]], [[1, 0, 0, 0]], v)
    _, vec3, _ = probe(vec4[:, 1], [[1, 0, 0, 0]], v)
    assert np.abs(vec3[0, 2] - v[0]).max() < 4 * TOL * max(angle, 1e-3)
