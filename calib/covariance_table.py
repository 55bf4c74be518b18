"""The table [covariance] of a rig.toml: version, names, standard deviations, correlations."""

from __future__ import annotations

import numpy as np

from calib.camera_table import number_text, string_text
from calib.errors import CalibError
from calib.models.camera import Array, OmniCamera
from calib.models.ocam import ASTIGMATISM_NAMES, MAX_COEFFICIENTS, TANGENTIAL_NAMES, OcamCamera
from calib.models.unified import OMNI_NAMES
from calib.models.wavefront import WAVEFRONT_NAMES
from calib.rig_covariance import MAX_PARAMETERS, TRANSFORM_NAMES, RigCovariance
from calib.validation import ValidatedTable

VERSION = 1  # the first: it rises when an earlier program would misread the file
OCAM_NAMES = (
    *(f"a{power}" for power in range(MAX_COEFFICIENTS)),
    "center_row",
    "center_column",
    "c",
    "d",
    *TANGENTIAL_NAMES,
    *ASTIGMATISM_NAMES,
    *WAVEFRONT_NAMES,
)


def read_covariance(table: ValidatedTable, cameras: tuple[OmniCamera, OmniCamera]) -> RigCovariance:
    """Read the covariance of the parameters of both cameras (lower, upper) and of the transform between them."""
    table.allow_only(("version", "parameters", "sigma", "correlation"))
    if table.values.get("version") != VERSION or type(table.values["version"]) is not int:
        table.fail("version", str(VERSION))
    names = _names(table, cameras)
    sigmas = table.numbers("sigma", len(names))
    correlation = _correlation(table, len(names))
    try:
        return RigCovariance(names, np.array(sigmas), correlation)
    except CalibError as error:
        raise CalibError(f"{table.file}: {table.path}: {error}") from error


def _names(table: ValidatedTable, cameras: tuple[OmniCamera, OmniCamera]) -> tuple[str, ...]:
    names = table.values.get("parameters")
    known = {
        *TRANSFORM_NAMES,
        *(
            f"{side} {name}"
            for side, camera in zip(("lower", "upper"), cameras, strict=True)
            for name in (OCAM_NAMES if isinstance(camera, OcamCamera) else OMNI_NAMES)
        ),
    }
    if (
        not isinstance(names, list)
        or not 1 <= len(names) <= MAX_PARAMETERS
        or not all(isinstance(name, str) and name in known for name in names)
    ):
        table.fail("parameters", f"1 to {MAX_PARAMETERS} names of the cameras' parameters and of the transform's")
    return tuple(names)


def _correlation(table: ValidatedTable, count: int) -> Array:
    """Read the correlations (P, P); row k has the k numbers left of the diagonal."""
    correlation = np.eye(count)
    rows = table.values.get("correlation")
    if not isinstance(rows, list) or [len(row) if isinstance(row, list) else -1 for row in rows] != [*range(count)]:
        table.fail("correlation", f"{count} rows of 0, 1, 2 ... numbers, those left of the diagonal")
    for k, row in enumerate(rows[1:], 1):
        values = ValidatedTable({"correlation": row}, table.file, table.path).numbers("correlation", k)
        correlation[k, :k] = correlation[:k, k] = values
    return correlation


def covariance_text(covariance: RigCovariance) -> str:
    """Return the table of a covariance, which parses to the same numbers."""
    names = ", ".join(map(string_text, covariance.names))
    sigmas = ", ".join(map(number_text, covariance.sigmas))
    rows = [f"    [{', '.join(map(number_text, row[:k]))}]," for k, row in enumerate(covariance.correlation)]
    return (
        "\n".join(
            [
                "",
                "[covariance]",
                f"version = {VERSION}",
                f"parameters = [{names}]",
                f"sigma = [{sigmas}]",
                "correlation = [",
                *rows,
                "]",
            ]
        )
        + "\n"
    )
