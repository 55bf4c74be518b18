"""The image that every test in a guest needs; the tests are skipped without it."""

from __future__ import annotations

import pytest

from tests.hardware.image import Image, ImageUnavailableError, image


@pytest.fixture(scope="session", autouse=True)
def guest_image() -> Image:
    """The image, built if necessary; without QEMU the tests are skipped with a message that names the packages."""
    try:
        return image()
    except ImageUnavailableError as reason:
        pytest.skip(str(reason))
