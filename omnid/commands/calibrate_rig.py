"""`omnid calibrate rig`: a rig.toml from simultaneous images of a checkerboard."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib import se3
from calib.boards.board import Board, BoardView
from calib.camera_file import CameraFile, read_camera
from calib.fit.camera_fit import MODELS, Model, Rejected, calibrate, sharpened
from calib.fit.rig_fit import PairView, RigCalibration, Sides, calibrate_rig, sharpened_rig
from calib.masks.rim import find_rim
from calib.masks.stack_mask import find_mask
from calib.models.camera import Mask
from calib.models.ocam import VIEWS, OcamCamera
from calib.models.unified import UnifiedCamera
from calib.rig import Rig
from calib.rig_file import write_file, write_rig
from calib.rig_frame import rig_between
from omnid.calibration.board_search import find_boards, spread
from omnid.calibration.image_pairs import SIDES, PairedImages, read_pairs
from omnid.calibration.images import Images
from omnid.calibration.rig_report import rig_report_html
from omnid.commands.calibrate_camera import corners
from omnid.errors import OmnidError
from omnid.sinks.files import check_outputs

MAX_LOG_VIEWS = 40
# The square's side scales everything: of a rig that can stand on a robot the baseline tells a wrong one.
SANE_BASELINE_M = (0.01, 3.0)
EXPECTED_PART, DOUBTFUL_PART = 0.1, 0.02


def add_parser(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `rig` to `omnid calibrate`."""
    parser = actions.add_parser("rig", help="a rig.toml from images of a checkerboard that both cameras saw at once")
    parser.add_argument("images", type=Path, metavar="LOG|DIR", help="a log of both cameras, or a folder with "
                        "lower_*.png, upper_*.png of the same names")
    parser.add_argument("--corners", required=True, type=corners, metavar="6x7", help="where four squares meet, "
                        "counted along both sides of the board")
    parser.add_argument("--square-mm", required=True, type=float, metavar="MM", help="side of one square")
    parser.add_argument("--expected-baseline-mm", type=float, metavar="MM", help="the measured distance of the "
                        "mirrors: refuses what is off by more than a tenth")
    parser.add_argument("--lower-camera", type=Path, metavar="FILE", help="camera.toml of the lower camera, taken as "
                        "it is")
    parser.add_argument("--upper-camera", type=Path, metavar="FILE", help="likewise")
    parser.add_argument("--refine-cameras", action="store_true", help="adjust the given cameras as well")
    parser.add_argument("--lower", metavar="TOPIC", help="a log's topic of the lower camera")
    parser.add_argument("--upper", metavar="TOPIC", help="likewise")
    parser.add_argument("--model", choices=MODELS, default="ocam", help="polynomial (default) or unified model")
    parser.add_argument("--view", choices=VIEWS, default="mirror", help="whether the world is seen in mirrors "
                        "(default) or directly through lenses: a flat board cannot tell")
    parser.add_argument("--mask", action="store_true", help="also find hub and struts, and paint the masks into PNGs "
                        "beside the rig's file: edit them as you like")
    parser.add_argument("--report", type=Path, metavar="FILE", help="a page (HTML) with all there is to see about it")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    parser.add_argument("-o", "--output", type=Path, required=True, help="the rig.toml to write")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Finds the boards, fits cameras and rig, writes the files and prints one line."""
    columns, rows = args.corners
    board = Board(columns, rows, args.square_mm / 1e3)
    given = _given(args)
    _check_outputs(args)
    images = read_pairs(args.images, args.lower, args.upper)
    _sizes_fit(images, given)
    found = _fitted(images, board, given, args)
    doubts = _check_baseline(found, args)
    rig, unmasked = _rig(found, images, given, args)
    write_rig(args.output, rig)
    if args.report:
        write_file(args.report, rig_report_html(found, images, rig).encode())
    for line in (*doubts, *unmasked, *(f"left out {bad.name}: {bad.reason}" for bad in found.rejected)):
        print(f"warning: {line}", file=sys.stderr)
    print(f"{args.output}: {describe(found)}")
    return 0


def _given(args: argparse.Namespace) -> tuple[CameraFile, CameraFile] | None:
    """Both cameras' files; OmnidError where only one is named or they see in different ways."""
    paths = [args.lower_camera, args.upper_camera]
    if not any(paths):
        if args.refine_cameras:
            raise OmnidError("--refine-cameras: expected --lower-camera and --upper-camera to refine, found neither")
        return None
    if not all(paths):
        raise OmnidError("calibrate rig: expected both --lower-camera and --upper-camera or neither, found one")
    files = read_camera(paths[0]), read_camera(paths[1])
    if _is_mirror(files[0]) != _is_mirror(files[1]):
        raise OmnidError("calibrate rig: one camera's file says it sees in a mirror, the other directly; make both "
                         "with the same --view")
    return files


def _is_mirror(file: CameraFile) -> bool:
    camera = file.camera
    if isinstance(camera, UnifiedCamera):
        return camera.focal[0] * camera.focal[1] < 0
    return isinstance(camera, OcamCamera) and camera.view == "mirror"


def _check_outputs(args: argparse.Namespace) -> None:
    named = [("--output", args.output), ("--report", args.report)]
    read = [("a file that is read", path) for path in (args.images, args.lower_camera, args.upper_camera)
            if path is not None and path.is_file()]
    check_outputs([(option, path) for option, path in named if path is not None], read)
    expected = args.expected_baseline_mm
    if expected is not None and not expected > 0:
        raise OmnidError(f"--expected-baseline-mm {expected:g}: expected a length above 0")


def _sizes_fit(images: PairedImages, given: tuple[CameraFile, CameraFile] | None) -> None:
    for name, side, file in zip(SIDES, images.sides, given or (), strict=False):
        height, width = next(iter(side.values())).shape
        if (width, height) != tuple(file.camera.size):
            raise OmnidError(f"--{name}-camera: it is of {file.camera.size[0]}x{file.camera.size[1]} px, the {name} "
                             f"images are {width}x{height} px; give the file of this camera")


def _fitted(images: PairedImages, board: Board, given: tuple[CameraFile, CameraFile] | None,
            args: argparse.Namespace) -> RigCalibration:
    """The rig from all boards; the cameras' own fits come first unless they are given."""
    views = _views(images, board, tell=not args.quiet)
    refined = given is None or args.refine_cameras
    if given:
        cameras, rejected = (given[0].camera, given[1].camera), list[Rejected]()
    else:
        cameras, views, rejected = _own_cameras(views, images, board, args)
    if not refined:
        rejected += [Rejected(view.name, f"only the {name} camera saw the board, which with given cameras says nothing")
                     for view in views for name, seen in zip(SIDES, view.seen[::-1], strict=True) if seen is None]
    found = calibrate_rig(views, board, cameras, refined)
    found = sharpened_rig(found, images.sides, refined)
    return _with_rejected(found, rejected)


def _with_rejected(found: RigCalibration, rejected: list[Rejected]) -> RigCalibration:
    return replace(found, rejected=(*rejected, *found.rejected))


def _views(images: PairedImages, board: Board, *, tell: bool) -> list[PairView]:
    """What both cameras saw of the board, by instant; of a log's many those that differ most."""
    found = [_found(side, board, (name, bool(images.topics[0]), tell))
             for name, side in zip(SIDES, images.sides, strict=True)]
    both = [found[0][name] for name in images.names if name in found[0] and name in found[1]]
    few = {view.name for view in spread(both, MAX_LOG_VIEWS)} if images.topics[0] and both else set(images.names)
    seen = [PairView(name, (found[0].get(name), found[1].get(name))) for name in images.names if name in few]
    return [view for view in seen if any(view.seen)]


def _found(images: Images, board: Board, how: tuple[str, bool, bool]) -> dict[str, BoardView]:
    name, is_log, tell = how
    try:
        views = find_boards(images, board, thorough=not is_log, tell=tell)
    except OmnidError as error:
        raise OmnidError(f"{name} camera: {error}") from error
    return {view.name: view for view in views}


def _own_cameras(views: list[PairView], images: PairedImages, board: Board, args: argparse.Namespace
                 ) -> tuple[Sides, list[PairView], list[Rejected]]:
    """Each camera from its own images, those alone among them; the views that are good, and which were left out."""
    model: Model = args.model
    cameras, rejected = [], list[Rejected]()
    for side, name in enumerate(SIDES):
        mine = [seen for view in views if (seen := view.seen[side]) is not None]
        height, width = images.sides[side][mine[0].name].shape if mine else (0, 0)
        found = calibrate(mine, board, (width, height), model, args.view)
        found = sharpened(found, images.sides[side], model, args.view)
        cameras.append(found.camera)
        rejected += [Rejected(bad.name, f"{name} camera: {bad.reason}") for bad in found.rejected]
        views = _without(views, side, {bad.name for bad in found.rejected})
    return (cameras[0], cameras[1]), views, rejected


def _without(views: list[PairView], side: int, names: set[str]) -> list[PairView]:
    """The views less what one camera saw at some instants; what the other saw then stays."""
    kept = [replace(view, seen=(None, view.seen[1]) if side == 0 else (view.seen[0], None)) if view.name in names
            else view for view in views]
    return [view for view in kept if any(view.seen)]


def _check_baseline(found: RigCalibration, args: argparse.Namespace) -> list[str]:
    """Doubts about the baseline; OmnidError where it cannot be."""
    baseline_mm, expected = found.baseline_m * 1e3, args.expected_baseline_mm
    low, high = SANE_BASELINE_M
    if not low <= found.baseline_m <= high:
        raise OmnidError(f"calibrate rig: a baseline of {baseline_mm:.4g} mm came out, expected {low * 1e3:.0f} to "
                         f"{high * 1e3:.0f} mm; it grows with --square-mm, which is {args.square_mm:g}: measure the "
                         "squares")
    if expected is None:
        return []
    off = baseline_mm / expected - 1
    if abs(off) > EXPECTED_PART:
        raise OmnidError(f"calibrate rig: a baseline of {baseline_mm:.1f} mm came out, {expected:g} mm were expected; "
                         f"with squares of {args.square_mm * expected / baseline_mm:.2f} mm it would be so: measure "
                         f"the squares (--square-mm is {args.square_mm:g}) and the mirrors")
    return [f"the baseline of {baseline_mm:.2f} mm is {abs(off):.1%} off the expected {expected:g} mm"] * (
        abs(off) > DOUBTFUL_PART)


def _rig(found: RigCalibration, images: PairedImages, given: tuple[CameraFile, CameraFile] | None,
         args: argparse.Namespace) -> tuple[Rig, list[str]]:
    """The rig with its masks, and what is to be said where a mirror's rim was not found."""
    rig = rig_between(found.lower, found.upper, se3.inverse(found.T_upper_lower), images.topics)
    masks = [_mask(found_camera.center, side, file, painted=args.mask)
             for found_camera, side, file in zip((found.lower, found.upper), images.sides, given or (None, None),
                                                 strict=True)]
    said = [f"no rim of a mirror was found in the {name} camera's images: the daemon looks for it again, or add "
            f"[{name}.mask] by hand" for name, mask in zip(SIDES, masks, strict=True) if mask is None]
    return replace(rig, lower=replace(rig.lower, mask=masks[0]), upper=replace(rig.upper, mask=masks[1])), said


def _mask(center: tuple[float, float], images: Images, file: CameraFile | None, *, painted: bool) -> Mask | None:
    """The mask to be painted, or that of the camera's file, or the rim in the brightest of all images."""
    if painted:
        return find_mask(list(images.values()), center)
    if file is not None and file.mask is not None:
        return file.mask
    return find_rim(np.max(list(images.values()), axis=0), center)


def describe(found: RigCalibration) -> str:
    """One line about a rig: error, pairs, baseline and turn with their deviations."""
    turn = np.rad2deg(np.linalg.norm(se3.rotation_log(found.T_upper_lower[:3, :3])))
    sigma = np.rad2deg(np.linalg.norm(found.motion_sigma[3:]))
    alone = len(found.views) - found.pairs
    return (f"baseline {found.baseline_m * 1e3:.2f} mm (deviation {found.baseline_sigma_m * 1e3:.2f}), upper turned "
            f"by {turn:.3f} deg ({sigma:.3f}), mean reprojection error {found.fit.mean_px:.3f} px, {found.pairs} pairs"
            + f", {alone} views of one camera alone" * (alone > 0))
