"""What every test in a guest needs: an image, or a reason to skip."""

from __future__ import annotations

import pytest

from tests.hardware.image import Image, NoImage, image


@pytest.fixture(scope="session", autouse=True)
def guest_image() -> Image:
    """The image, built if need be; without QEMU the tests are skipped with what to install."""
    try:
        return image()
    except NoImage as reason:
        pytest.skip(str(reason))
