"""What a driver's classes declare is what the API replies and what records keep."""

from __future__ import annotations

from dataclasses import fields

import pytest

from stereorig.core.names import CAMERAS
from stereorig.drivers.acquisition.pairing import PairingAccount
from stereorig.drivers.cameras.protocol import CameraDescription, CameraSettings, FoundDevice, FrameCounters
from stereorig.drivers.stages.protocol import (
    AxisDynamics,
    AxisIdentity,
    AxisLimits,
    AxisStatus,
    ControllerMessage,
    StageIdentity,
)
from stereorig.server.api.models.rig import FrameCounts, PairCounts
from stereorig.server.base.models import Reply, Reported
from stereorig.server.config.camera_metadata import CameraMetadata, LensMetadata
from stereorig.server.rig import description as replies
from stereorig.server.rig.devices import ListedDevice
from tests.support.service_rig import tiny_config


@pytest.mark.parametrize(
    ("declared", "reply"),
    [
        (CameraDescription, replies.CameraDevice),
        (CameraSettings, replies.CameraSettingsReply),
        (FoundDevice, ListedDevice),
        (FrameCounters, FrameCounts),
        (PairingAccount, PairCounts),
        (AxisIdentity, replies.AxisIdentityReply),
        (StageIdentity, replies.StageIdentityReply),
        (AxisLimits, replies.AxisLimitsReply),
        (AxisDynamics, replies.DynamicsReply),
        (AxisStatus, replies.AxisReply),
        (ControllerMessage, replies.StageMessage),
    ],
)
def test_each_field_of_a_driver_is_replied_with_its_meaning(declared: type, reply: type[Reply]) -> None:
    schema = reply.model_json_schema(mode="serialization")
    for field in fields(declared):
        assert schema["properties"][field.name]["description"]
    if issubclass(reply, Reported):
        assert schema["required"] == list(schema["properties"])


def test_a_record_keeps_missing_settings_as_null_and_leaves_unstated_facts_out() -> None:
    settings = CameraSettings(exposure_ms=5.0, bit_depth=8, features={"BlackLevel": 4.0})
    kept = replies.kept_camera(settings, CameraMetadata(maker="Basler", lens=LensMetadata(f_number=8.0)))
    assert kept.model_dump(exclude_unset=True) == {
        "exposure_ms": 5.0,
        "gain_db": None,
        "frame_rate_hz": None,
        "pixel_format": None,
        "maker": "Basler",
        "lens": {"f_number": 8.0},
    }


def test_a_rig_that_is_not_open_yet_says_so() -> None:
    from stereorig.server.jobs.hardware import HardwareHold
    from stereorig.server.rig.rig import Rig

    hardware = HardwareHold()
    rig = Rig(tiny_config(), hardware)
    try:
        shown = rig.describe().model_dump(exclude_unset=True)
    finally:
        hardware.close()
    assert shown["connected"] is False
    assert shown["fault"]["code"] == shown["stage"]["fault"]["code"] == "not_connected"
    assert shown["fault"]["remedy"]
    for cam in CAMERAS:
        assert shown["cameras"][cam]["device"] is None
        assert "fault" not in shown["cameras"][cam]
