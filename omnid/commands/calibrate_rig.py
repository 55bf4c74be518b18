"""`omnid calibrate rig`: calibrate a rig by simultaneous images of a board."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib import se3
from calib.boards.board import BoardView
from calib.camera_file import CameraFile, read_camera
from calib.fit.camera_fit import RejectedView
from calib.fit.model_selection import MODEL_CHOICES, refine_selection, select_calibration
from calib.fit.rig_fit import PairView, RigCalibration, Sides, calibrate_rig, refine_rig_calibration
from calib.fit.rig_selection import select_rig
from calib.fit.rig_uncertainty import drive_uncertainty, rig_covariance
from calib.masks.rim import find_rim
from calib.masks.stack_mask import find_mask
from calib.models.camera import Mask
from calib.models.ocam import VIEWS, OcamCamera
from calib.models.unified import UnifiedCamera
from calib.rig import Rig
from calib.rig_file import write_file, write_rig
from calib.rig_frame import rig_between
from omnid.calibration.board_search import AnyBoard, find_boards, select_diverse_views
from omnid.calibration.image_pairs import SIDES, PairedImages, read_pairs
from omnid.calibration.images import Images
from omnid.calibration.rig_report import rig_report_html
from omnid.commands.board_options import add_board_options, board_of, length_option
from omnid.commands.calibrate_camera import MODEL_HELP, misfit_warnings, print_scores
from omnid.errors import OmnidError
from omnid.sinks.files import check_outputs

MAX_LOG_VIEWS = 40
# The board scales the rig: a baseline outside this range shows a wrong --square-mm or --tag-mm.
BASELINE_RANGE_M = (0.01, 3.0)
# Relative difference from the expected baseline that is refused, and that gives a warning.
REFUSED_PART, WARNING_PART = 0.1, 0.02


def add_parser(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `rig` to `omnid calibrate`."""
    parser = actions.add_parser("rig", help="a rig.toml from images of a board that both cameras saw at once")
    parser.add_argument("images", type=Path, metavar="LOG|DIR", help="a log of both cameras, or a folder with "
                        "lower_*.png, upper_*.png of the same names")
    add_board_options(parser)
    parser.add_argument("--expected-baseline-mm", type=float, metavar="MM", help="the measured distance of the "
                        "mirrors: a result that differs by more than a tenth is refused")
    parser.add_argument("--lower-camera", type=Path, metavar="FILE", help="camera.toml of the lower camera, which is "
                        "not changed")
    parser.add_argument("--upper-camera", type=Path, metavar="FILE", help="the same for the upper camera")
    parser.add_argument("--refine-cameras", action="store_true", help="adjust the given cameras as well")
    parser.add_argument("--lower", metavar="TOPIC", help="a log's topic of the lower camera")
    parser.add_argument("--upper", metavar="TOPIC", help="a log's topic of the upper camera")
    parser.add_argument("--model", choices=MODEL_CHOICES, default="auto", help=MODEL_HELP)
    parser.add_argument("--view", choices=VIEWS, default="mirror", help="the world is seen in mirrors (default) or "
                        "directly through lenses: images of a flat board do not distinguish the two")
    parser.add_argument("--mask", action="store_true", help="also find hub and struts, and write the masks to PNGs in "
                        "the folder of the rig's file; they may be edited")
    parser.add_argument("--report", type=Path, metavar="FILE", help="write an HTML report with residuals and panoramas")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    parser.add_argument("-o", "--output", type=Path, required=True, help="the rig.toml to write")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Find the boards, fit cameras and rig, write the files and print one line."""
    board = board_of(args)
    given = _given(args)
    _check_outputs(args)
    images = read_pairs(args.images, args.lower, args.upper)
    _sizes_fit(images, given)
    found = _fitted(images, board, given, args)
    warnings = _check_baseline(found, args)
    rig, unmasked = _rig(found, images, given, args)
    write_rig(args.output, rig)
    if args.report:
        write_file(args.report, rig_report_html(found, images, rig).encode())
    misfit = misfit_warnings({f"{name} camera": found.structure(side) for side, name in enumerate(SIDES)})
    for line in (*misfit, *warnings, *unmasked, *(f"left out {bad.name}: {bad.reason}" for bad in found.rejected)):
        print(f"warning: {line}", file=sys.stderr)
    uncertainty = drive_uncertainty(rig)
    predicted = f"; drives: {uncertainty}" if uncertainty is not None and any(found.parameters) else ""
    print(f"{args.output}: {'MISFIT: ' if misfit else ''}{describe(found)}{predicted}")
    return 0


def _given(args: argparse.Namespace) -> tuple[CameraFile, CameraFile] | None:
    """Read both cameras' files, if named; raises OmnidError if only one is, or if their views differ."""
    paths = [args.lower_camera, args.upper_camera]
    if not any(paths):
        if args.refine_cameras:
            raise OmnidError("--refine-cameras: expected --lower-camera and --upper-camera to refine, found neither")
        return None
    if not all(paths):
        raise OmnidError("calibrate rig: expected both --lower-camera and --upper-camera or neither, found one")
    files = read_camera(paths[0]), read_camera(paths[1])
    if _is_mirror(files[0]) != _is_mirror(files[1]):
        raise OmnidError("calibrate rig: expected cameras of the same view, found one of a mirror and one of a lens; "
                         "calibrate both with the same --view")
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
            raise OmnidError(f"--{name}-camera: expected a camera of {width}x{height} px like the {name} images, found "
                             f"{file.camera.size[0]}x{file.camera.size[1]} px; give the file of this camera")


def _fitted(images: PairedImages, board: AnyBoard, given: tuple[CameraFile, CameraFile] | None,
            args: argparse.Namespace) -> RigCalibration:
    """Fit the rig to all boards; the cameras are fitted first, unless they are given."""
    views = _views(images, board, show_progress=not args.quiet)
    refined = given is None or args.refine_cameras
    mirrors: tuple[OcamCamera, OcamCamera] | None = None
    if given:
        cameras, rejected = (given[0].camera, given[1].camera), list[RejectedView]()
    else:
        cameras, mirrors, views, rejected = _calibrated_cameras(views, images, board, args)
    if not refined:
        rejected += [RejectedView(view.name, f"only the {name} camera saw the board; with given cameras pairs are "
                                             "needed")
                     for view in views for name, seen in zip(SIDES, view.seen[::-1], strict=True) if seen is None]
    if refined:
        selected = select_rig(views, board, cameras, mirrors)
        found = selected.calibration
        for number, score in enumerate(selected.scores if not args.quiet else ()):
            print(f"rig: {'compared' if number else 'selected'} {score}", file=sys.stderr)
    else:
        found = calibrate_rig(views, board, cameras, refined)
    found = refine_rig_calibration(found, images.sides, refined)
    return _with_rejected(found, rejected)


def _with_rejected(found: RigCalibration, rejected: list[RejectedView]) -> RigCalibration:
    return replace(found, rejected=(*rejected, *found.rejected))


def _views(images: PairedImages, board: AnyBoard, *, show_progress: bool) -> list[PairView]:
    """Find the board in the images of both cameras; of a log's many pairs the most diverse ones are selected."""
    found = [_found(side, board, name, is_log=bool(images.topics[0]), show_progress=show_progress)
             for name, side in zip(SIDES, images.sides, strict=True)]
    both = [found[0][name] for name in images.names if name in found[0] and name in found[1]]
    selected = set(images.names)
    if images.topics[0] and both:
        selected = {view.name for view in select_diverse_views(both, MAX_LOG_VIEWS)}
    seen = [PairView(name, (found[0].get(name), found[1].get(name))) for name in images.names if name in selected]
    return [view for view in seen if any(view.seen)]


def _found(images: Images, board: AnyBoard, name: str, *, is_log: bool, show_progress: bool) -> dict[str, BoardView]:
    """Find the board in the images of the camera of that name; returns the views by the names of the images."""
    try:
        views = find_boards(images, board, thorough=not is_log, show_progress=show_progress)
    except OmnidError as error:
        raise OmnidError(f"{name} camera: {error}") from error
    return {view.name: view for view in views}


def _calibrated_cameras(views: list[PairView], images: PairedImages, board: AnyBoard, args: argparse.Namespace
                        ) -> tuple[Sides, tuple[OcamCamera, OcamCamera] | None, list[PairView], list[RejectedView]]:
    """Calibrate each camera by all its images.

    Returns the cameras, polynomial ones for the terms of real mirrors (None if these are not asked for), the accepted
    views and the rejected ones.
    """
    cameras, polynomials, rejected = [], list[OcamCamera](), list[RejectedView]()
    for side, name in enumerate(SIDES):
        side_views = [seen for view in views if (seen := view.seen[side]) is not None]
        height, width = images.sides[side][side_views[0].name].shape if side_views else (0, 0)
        selected = select_calibration(side_views, board, (width, height), args.model, args.view)
        print_scores(selected, f"{name} camera", args.quiet)
        found = refine_selection(selected, images.sides[side], args.view).calibration
        cameras.append(found.camera)
        if selected.polynomial is not None:
            polynomials.append(selected.polynomial)
        rejected += [RejectedView(bad.name, f"{name} camera: {bad.reason}") for bad in found.rejected]
        views = _without(views, side, {bad.name for bad in found.rejected})
    general = args.model == "auto" and len(polynomials) == len(SIDES)
    return (cameras[0], cameras[1]), (polynomials[0], polynomials[1]) if general else None, views, rejected


def _without(views: list[PairView], side: int, names: set[str]) -> list[PairView]:
    """Remove one camera's views of the named instants; the other camera's views are kept."""
    kept = []
    for view in views:
        if view.name not in names:
            kept.append(view)
            continue
        lower, upper = view.seen
        kept.append(replace(view, seen=(None, upper) if side == 0 else (lower, None)))
    return [view for view in kept if any(view.seen)]


def _check_baseline(found: RigCalibration, args: argparse.Namespace) -> list[str]:
    """Return warnings about the baseline; raises OmnidError if it is far from the expected one."""
    baseline_mm, expected = found.baseline_m * 1e3, args.expected_baseline_mm
    (option, length_mm), (low, high) = length_option(args), BASELINE_RANGE_M
    if not low <= found.baseline_m <= high:
        raise OmnidError(f"calibrate rig: expected a baseline of {low * 1e3:.0f} to {high * 1e3:.0f} mm, found "
                         f"{baseline_mm:.4g} mm; it is proportional to {option}, which is {length_mm:g}: "
                         "measure the board")
    if expected is None:
        return []
    off = baseline_mm / expected - 1
    if abs(off) > REFUSED_PART:
        raise OmnidError(f"calibrate rig: expected a baseline of {expected:g} mm, found {baseline_mm:.1f} mm; "
                         f"{option} {length_mm * expected / baseline_mm:.2f} would explain it: measure the board "
                         f"({option} is {length_mm:g}) and the distance of the mirrors")
    if abs(off) > WARNING_PART:
        return [f"the baseline of {baseline_mm:.2f} mm is {abs(off):.1%} off the expected {expected:g} mm"]
    return []


def _rig(found: RigCalibration, images: PairedImages, given: tuple[CameraFile, CameraFile] | None,
         args: argparse.Namespace) -> tuple[Rig, list[str]]:
    """Return the rig with its masks and covariance, and warnings about mirrors without a rim in the images."""
    rig = rig_between(found.lower, found.upper, se3.inverse(found.T_upper_lower), images.topics)
    masks = [_mask(found_camera.center, side, file, with_struts=args.mask)
             for found_camera, side, file in zip((found.lower, found.upper), images.sides, given or (None, None),
                                                 strict=True)]
    warnings = [f"no rim of a mirror was found in the {name} camera's images: the daemon searches for it at start, or "
                f"add [{name}.mask] by hand" for name, mask in zip(SIDES, masks, strict=True) if mask is None]
    masked = replace(rig, lower=replace(rig.lower, mask=masks[0]), upper=replace(rig.upper, mask=masks[1]))
    return replace(masked, covariance=rig_covariance(found, rig)), warnings


def _mask(center: tuple[float, float], images: Images, file: CameraFile | None, *, with_struts: bool) -> Mask | None:
    """Return the mask with hub and struts, or that of the camera's file, or the rim in the maximum of all images."""
    if with_struts:
        return find_mask(list(images.values()), center)
    if file is not None and file.mask is not None:
        return file.mask
    return find_rim(np.max(list(images.values()), axis=0), center)


def describe(found: RigCalibration) -> str:
    """Return one line about a rig: baseline and rotation with their sigmas, error, pairs."""
    rotation_deg = np.rad2deg(np.linalg.norm(se3.rotation_log(found.T_upper_lower[:3, :3])))
    sigma_deg = np.rad2deg(np.linalg.norm(found.motion_sigma[3:]))
    single_views = len(found.views) - found.pairs
    line = (f"baseline {found.baseline_m * 1e3:.2f} mm (sigma {found.baseline_sigma_m * 1e3:.2f}), upper rotated by "
            f"{rotation_deg:.3f} deg (sigma {sigma_deg:.3f}), mean reprojection error {found.fit.mean_px:.3f} px, "
            f"{found.pairs} pairs")
    return f"{line}, {single_views} views of one camera alone" if single_views else line
