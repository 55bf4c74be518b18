"""`omnid calibrate camera`: calibrate one camera by images of a board."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.boards.board import BoardView, CalibrationBoard
from calib.camera_file import CameraFile, Quality, camera_toml
from calib.fit.camera_fit import CameraCalibration
from calib.fit.model_selection import (
    MODEL_CHOICES,
    SelectedCalibration,
    camera_structure,
    refine_selection,
    select_calibration,
)
from calib.fit.residual_structure import ResidualStructure
from calib.masks.stack_mask import find_mask
from calib.models.camera import Mask
from calib.models.ocam import VIEWS
from calib.rig_file import write_file
from omnid.calibration.board_search import find_boards, select_diverse_views
from omnid.calibration.camera_report import camera_report_html
from omnid.calibration.images import Images, read_images
from omnid.commands.board_options import add_board_options, board_of
from omnid.errors import OmnidError
from omnid.sinks.files import check_outputs

# A log shows similar views many times: this number of diverse views is as good as all, in a fraction of the time.
MAX_LOG_VIEWS = 40


MODEL_HELP = ("auto (default): fit all models and select by cross-validation; omni: unified model; ocam: polynomial; "
              "ocam_tangential: polynomial with tangential terms")
MISFIT = "the camera model does not describe this camera: {}; do not use it where accuracy matters"


def add_parser(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `camera` to `omnid calibrate`."""
    parser = actions.add_parser("camera", help="a camera.toml from images of a board")
    parser.add_argument("images", nargs="+", metavar="IMAGES|LOG", help="files, folders or patterns, or one .mcap")
    add_board_options(parser)
    parser.add_argument("--topic", help="the camera's topic in a log")
    parser.add_argument("--model", choices=MODEL_CHOICES, default="auto", help=MODEL_HELP)
    parser.add_argument("--view", choices=VIEWS, default="mirror", help="the world is seen in a mirror (default) or "
                        "directly through a lens: images of a flat board do not distinguish the two")
    parser.add_argument("--report", type=Path, metavar="FILE", help="write an HTML report with residuals and coverage")
    parser.add_argument("--mask", type=Path, metavar="FILE", help="also find rim, hub and struts, and write them to "
                        "this PNG in the folder of the camera's file; it may be edited")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    parser.add_argument("-o", "--output", type=Path, required=True, help="the camera.toml to write")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Find the boards, fit the camera, write the files and print one line."""
    board = board_of(args)
    _check_outputs(args)
    images = read_images(args.images, args.topic)
    many = any(source.endswith(".mcap") for source in args.images)
    views = find_boards(images, board, thorough=not many, show_progress=not args.quiet)
    views = select_diverse_views(views, MAX_LOG_VIEWS) if many else views
    selected = _fitted(views, images, board, args)
    found = selected.calibration
    mask = find_mask(list(images.values()), found.camera.center) if args.mask else None
    _write(found, mask, args)
    if args.report:
        missing = sorted(set(images) - {view.name for view in views})
        write_file(args.report, camera_report_html(found, images, missing, mask).encode())
    misfit = misfit_warnings({"camera": camera_structure(found)})
    for line in (*misfit, *found.warnings, *(f"left out {bad.name}: {bad.reason}" for bad in found.rejected)):
        print(f"warning: {line}", file=sys.stderr)
    print(f"{args.output}: {'MISFIT: ' if misfit else ''}model {selected.model}, {describe(found)}")
    return 0


def _check_outputs(args: argparse.Namespace) -> None:
    named = [("--output", args.output), ("--report", args.report), ("--mask", args.mask)]
    read = [("an image that is read", Path(source)) for source in args.images if Path(source).is_file()]
    check_outputs([(option, path) for option, path in named if path is not None], read)
    if args.mask and (args.mask.suffix.lower() != ".png" or args.mask.parent.resolve() != args.output.parent.resolve()):
        raise OmnidError(f"--mask {args.mask}: expected a .png in the folder of {args.output}")


def _fitted(views: list[BoardView], images: Images, board: CalibrationBoard, args: argparse.Namespace
            ) -> SelectedCalibration:
    height, width = images[views[0].name].shape
    selected = select_calibration(views, board, (width, height), args.model, args.view)
    print_scores(selected, "camera", args.quiet)
    return refine_selection(selected, images, args.view)


def print_scores(selected: SelectedCalibration, name: str, quiet: bool) -> None:
    """Print the scores of all fitted models to stderr, unless quiet."""
    if not quiet:
        for score in selected.scores:
            mark = "selected" if score.model == selected.model else "compared"
            print(f"{name}: {mark} {score}", file=sys.stderr)


def misfit_warnings(structures: Mapping[str, ResidualStructure]) -> list[str]:
    """Return one warning for every camera, by name, whose residuals are not explained by noise."""
    return [f"{name}: {MISFIT.format(structure)}" for name, structure in structures.items() if structure.is_misfit]


def _write(found: CameraCalibration, mask: Mask | None, args: argparse.Namespace) -> None:
    if mask is not None and mask.image is not None:
        write_file(args.mask, _png(mask.image))
    quality = Quality(found.fit.mean_px, len(found.views), found.parameters)
    name = args.mask.name if args.mask else ""
    write_file(args.output, camera_toml(CameraFile(found.camera, mask), quality, name).encode())


def _png(image: NDArray[np.uint8]) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def describe(found: CameraCalibration) -> str:
    """Return one line about a camera: size, centre, error, views."""
    u, v = found.camera.center
    corners = int(np.isfinite(found.fit.errors_px).sum())
    return (f"{found.camera.size[0]}x{found.camera.size[1]}, centre {u:.2f} {v:.2f}, mean reprojection error "
            f"{found.fit.mean_px:.3f} px over {corners} corners of {len(found.views)} views")
