"""rig.toml: exact round trips, masks, covariance, one-line errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib import se3
from calib.errors import CalibError
from calib.fit.parameters import central_names
from calib.models.camera import Array, Mask
from calib.rig import TRANSFORM_NAMES, MountedCamera, Rig, RigCovariance, ShutterTimes
from calib.rig_file import parse_rig, read_rig, rig_toml, write_rig


def with_masks(rig: Rig) -> Rig:
    width, height = rig.upper.camera.size
    image = np.random.default_rng(0).integers(0, 2, (height, width)).astype(np.uint8) * 255
    return replace(
        rig,
        lower=replace(rig.lower, mask=Mask((384.1, 383.2), 0.0, 371.3)),
        upper=replace(rig.upper, mask=Mask((383.9, 384.0), 61.5, image=image)),
    )


def assert_same(a: MountedCamera, b: MountedCamera) -> None:
    assert a.camera == b.camera
    np.testing.assert_array_equal(a.T_cam_rig[:3, :3], b.T_cam_rig[:3, :3])
    np.testing.assert_allclose(a.T_cam_rig[:3, 3], b.T_cam_rig[:3, 3], atol=2e-12)
    if a.mask is None or b.mask is None:
        assert a.mask is b.mask
        return
    assert (a.mask.center, a.mask.inner_px, a.mask.outer_px) == (b.mask.center, b.mask.inner_px, b.mask.outer_px)
    np.testing.assert_array_equal(a.mask.image, b.mask.image)


@pytest.mark.parametrize("masks", [False, True])
def test_a_rig_that_is_written_is_read_exactly(rig: Rig, masks: bool, tmp_path: Path) -> None:
    rig = with_masks(rig) if masks else rig
    write_rig(tmp_path / "rig.toml", rig)
    for found in (read_rig(str(tmp_path / "rig.toml")), parse_rig(rig_toml(rig)), parse_rig(rig_toml(rig).encode())):
        assert_same(found.lower, rig.lower)
        assert_same(found.upper, rig.upper)
        np.testing.assert_array_equal(found.T_base_rig, rig.T_base_rig)
        assert found.topics == rig.topics
        assert rig_toml(found) == rig_toml(rig)
        again = parse_rig(rig_toml(found))
        np.testing.assert_array_equal(again.upper.T_cam_rig, found.upper.T_cam_rig)


def test_a_pose_on_the_robot_that_is_not_stated_is_left_out_and_one_without_a_height_states_none(rig: Rig) -> None:
    unstated = replace(rig, T_base_rig=np.eye(4))
    assert "T_base_rig" not in rig_toml(unstated) and parse_rig(rig_toml(unstated)).height_m() is None
    shifted = replace(rig, T_base_rig=se3.transform(np.eye(3), [0.3, 0.0, -float(rig.lower.viewpoint[2])]))
    assert "T_base_rig" in rig_toml(shifted) and shifted.height_m() is None
    assert shifted.height_m(floor_m=-1.2) == pytest.approx(1.2)


def test_the_file_contains_the_camera_poses(omni_rig: Rig, around: Array) -> None:
    """A round trip does not detect T_rig_upper written as its inverse; a transformed point does."""
    import tomllib

    values = tomllib.loads(rig_toml(omni_rig))
    np.testing.assert_allclose(np.array(values["upper"]["T_rig_upper"])[:3, 3], omni_rig.upper.viewpoint, atol=1e-12)
    point_upper = omni_rig.upper.T_cam_rig @ np.r_[around[0], 1]
    np.testing.assert_allclose(np.array(values["upper"]["T_rig_upper"]) @ point_upper, np.r_[around[0], 1], atol=1e-10)
    u, v = values["lower"]["intrinsics"]["fu"], values["lower"]["intrinsics"]["fv"]
    assert (u, v) == (-205.0, 211.0)


ROWS = "[0.0, 0.0, 0.0, 1.0],\n]\n\n[lower]"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("schema = 1", "schema = 2", "schema: expected version 1, found 2"),
        ("schema = 1", "schema = 1\nspeed = 3", "unknown key speed: known are schema, lower"),
        ("xi = 0.93", "xi = '0.93'", "lower.intrinsics.xi: expected a number, found '0.93'"),
        ("xi = 0.93", "xi = 0.93\nk3 = 0.0", "unknown key lower.intrinsics.k3: known are lower.intrinsics.xi, "),
        ("fu = -205.0\n", "", "lower.intrinsics.fu is missing"),
        ('model = "omni"', 'model = "pinhole"', "lower.model: expected one of 'omni', 'ocam', 'ds', 'equi"),
        (
            'model = "omni"',
            'model = "omni"\nview = "mirror"',
            "lower.view: expected mirror or direct for",
        ),
        ("size = [768, 770]", "size = [32767, 32767]", "at most 67108864 in all"),
        ("T_rig_lower = [", "T_rig_upper = [", "lower: expected T_rig_lower, found that of the other camera"),
        (ROWS, ROWS.replace("0.0, 1.0", "0.5, 1.0"), "T_base_rig: expected a rotation"),
        ("inner_px = 0.0", "image = 'data:image/png;base64,AAAA'", "lower.mask.image: expected an image"),
        ("inner_px = 0.0", "image = 'drawn.png'", "lower.mask.image: expected an embedded image"),
        ("upper_delay_s = 0.00725", "upper_delay_s = 2.0", "times.upper_delay_s: expected a number from -1.0 to 1.0"),
        ('"lower xi"', '"baseline"', "covariance: expected different parameters"),
        ("sigma = [2.0, ", "sigma = [", "covariance: expected 3 sigmas"),
        ("[0.0, 0.25]", "[0.0]", "covariance.correlation: expected 3 rows"),
    ],
)
def test_errors_name_the_key(omni_rig: Rig, old: str, new: str, message: str) -> None:
    known = RigCovariance.of_matrix(("lower xi", "r_x", "baseline"), np.array([[4, 1, 0], [1, 9.0, 3], [0, 3, 16]]))
    whole = replace(with_masks(omni_rig), times=ShutterTimes(7.25e-3, -26e-6), covariance=known)
    text = rig_toml(whole)
    assert old in text and parse_rig(text).times == whole.times and parse_rig(text).covariance is not None
    with pytest.raises(CalibError) as caught:
        parse_rig(text.replace(old, new, 1), name="my.toml")
    assert str(caught.value).startswith("my.toml: ") and str(caught.value).count("my.toml") == 1
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "polynomial = [",
            f"polynomial = [{'-1.0, ' * 200}",
            "expected 1 to 32 coefficients, found 205",
        ),
        ('"lower a4"', '"lower a999999999"', "covariance.parameters: expected names of the cameras' parameters"),
    ],
)
def test_polynomials_are_bounded(ocam_rig: Rig, old: str, new: str, message: str) -> None:
    text = rig_toml(replace(ocam_rig, covariance=RigCovariance(("lower a4",), np.ones(1), np.eye(1))))
    assert parse_rig(text).covariance is not None
    with pytest.raises(CalibError, match=message):
        parse_rig(text.replace(old, new, 1))


def test_the_image_of_a_mask_has_the_size_of_the_images(omni_rig: Rig) -> None:
    mask = Mask((1.0, 1.0), image=np.zeros((4, 5), np.uint8))
    with pytest.raises(CalibError, match=r"lower\.mask\.image: expected \(768, 770\).* found \(5, 4\)"):
        parse_rig(rig_toml(replace(omni_rig, lower=replace(omni_rig.lower, mask=mask))))


def test_unreadable_files_are_one_line_errors(omni_rig: Rig, tmp_path: Path) -> None:
    for path, message in ((tmp_path / "none.toml", "there is no such rig"), (tmp_path, "cannot be read")):
        with pytest.raises(CalibError, match=message):
            read_rig(path)
    with pytest.raises(CalibError, match="cannot be written"):
        write_rig(tmp_path / "no" / "rig.toml", omni_rig)
    (tmp_path / "bytes.toml").write_bytes(b"schema = 1\xff")
    with pytest.raises(CalibError, match="expected TOML"):
        read_rig(tmp_path / "bytes.toml")


def names_of(rig: Rig) -> tuple[str, ...]:
    sides = (("lower", rig.lower), ("upper", rig.upper))
    return (
        *(f"{side} {name}" for side, mounted in sides for name in central_names(mounted.camera)),
        *TRANSFORM_NAMES,
    )


def random_matrix(count: int) -> Array:
    """Return a covariance whose variances span 16 orders of magnitude."""
    rng = np.random.default_rng(3)
    factor = rng.standard_normal((count, count)) * np.logspace(-8, 0, count)[:, None]
    return np.asarray(factor @ factor.T)


def test_a_covariance_that_is_written_is_read_exactly(rig: Rig) -> None:
    names = names_of(rig)
    matrix = random_matrix(len(names))
    text = rig_toml(replace(rig, covariance=RigCovariance.of_matrix(names, matrix)))
    found = parse_rig(text).covariance
    assert found is not None and found.names == names
    np.testing.assert_allclose(found.matrix, matrix, rtol=0, atol=1e-11 * np.diag(matrix).max())
    np.testing.assert_allclose(found.sigmas**2, np.diag(matrix), rtol=1e-12)
    assert rig_toml(parse_rig(text)) == text
    assert parse_rig(rig_toml(rig)).covariance is None
