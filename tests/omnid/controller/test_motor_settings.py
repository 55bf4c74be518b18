"""Settings of the motor controller and of the base."""

from __future__ import annotations

from omnid.config import Config
from omnid.controller.motor_settings import DriveSettings
from omnid.settings import parse


def test_reads_the_drive_from_its_section() -> None:
    config = parse(Config, b"[motor.drive]\ntrack_m = 0.62\nreverse_left = true\ncan_id = 7", origin="test")
    assert config.motor.drive == DriveSettings(track_m=0.62, reverse_left=True, can_id=7)
