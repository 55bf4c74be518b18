"""Constants say why they have their values: the number of those that do not, or were judged, may only fall."""

from __future__ import annotations

import pytest

from tests.benchmark.constants import PAGE, Constant, by_judgement, constants, constants_of, missing, page

# Lower them with each reason that is written.
MOST_WITHOUT_A_REASON = 0
MOST_BY_JUDGEMENT = 196

SOURCE = '''"""Text."""
NAMED = "text with 3"

# Measured on a bench, where a line gives no other reason.
FIRST_PX = 3
SECOND_PX = 2.5  # of a window
# So that it is odd.
ODD_PX = 5
PART_PX = 4  # of another
# A third one.
THIRD_PX = 1
FOURTH_PX = 1
# Set by trial.
FIFTH_PX = 6  # so that it is even

ALONE_M, OTHER_RAD = 0.1, 2 * 3.0  # of the base
STEP_RAD = 0.3  # the paper's step, Dang et al. 2012, section IV.F
PLAIN = 7
COLON_PX = 4  # of a window: the left one; that on which the edge is measured, and which must be there
INDEXED = NAMES[2]
JUDGED = 8  # so that it fits; by judgement, not measured
ONE = np.float32(1.0)
LOWER, UPPER = 0, 1
DERIVED = FIRST_PX * FIRST_PX


class Settings:
    window_px: int = knob(11, "side of the window, px")
'''


def test_reads_names_values_units_and_comments() -> None:
    found = {one.name: one for one in constants_of(SOURCE, "a.py")}
    assert list(found) == [
        "FIRST_PX",
        "SECOND_PX",
        "ODD_PX",
        "PART_PX",
        "THIRD_PX",
        "FOURTH_PX",
        "FIFTH_PX",
        "ALONE_M",
        "OTHER_RAD",
        "STEP_RAD",
        "PLAIN",
        "COLON_PX",
        "JUDGED",
        "window_px",
    ]
    assert (found["SECOND_PX"].value, found["SECOND_PX"].unit) == ("2.5", "px")
    assert found["SECOND_PX"].comment == ("Measured on a bench, where a line gives no other reason. of a window")
    assert found["PART_PX"].comment == "of another", "the reason above is that of ODD_PX"
    assert found["THIRD_PX"].comment == found["FOURTH_PX"].comment == "A third one.", "the first one ends there"
    assert found["FIFTH_PX"].comment == "so that it is even", "a reason of its own needs no other"
    assert (found["OTHER_RAD"].value, found["ALONE_M"].comment) == ("2 * 3.0", "of the base")
    assert found["STEP_RAD"].source == "Dang et al. 2012, section IV.F" or "paper" in found["STEP_RAD"].source
    assert found["window_px"].is_knob and found["window_px"].comment == "side of the window, px"


def test_tells_a_reason_from_a_description() -> None:
    found = constants_of(SOURCE, "a.py")
    lacking = ["PART_PX", "THIRD_PX", "FOURTH_PX", "ALONE_M", "OTHER_RAD", "PLAIN", "COLON_PX"]
    assert [one.name for one in missing(found)] == lacking
    assert "| `PLAIN` | `7` |" in page(found)


def test_a_judgement_is_no_reason_and_is_counted_apart() -> None:
    found = constants_of(SOURCE, "a.py")
    assert [one.name for one in by_judgement(found)] == ["JUDGED"]
    assert "| all | 14 | 1 | 7 |" in page(found), "settings and constants, judged ones, those without a reason"


@pytest.fixture(scope="module")
def found() -> list[Constant]:
    """Return all constants of the packages."""
    return constants()


def test_the_table_is_as_the_sources_are(found: list[Constant]) -> None:
    assert PAGE.read_text() == page(found), "python -m tests.benchmark.constants --write"


def test_constants_without_a_reason_do_not_become_more(found: list[Constant]) -> None:
    judged = by_judgement(found)
    assert len(judged) <= MOST_BY_JUDGEMENT, f"derive or measure a new constant: {[one.name for one in judged]}"
    without = missing(found)
    assert len(without) <= MOST_WITHOUT_A_REASON, f"give a reason for a new constant: {[one.name for one in without]}"
