"""Names of one setting in the descriptions of cameras: SFNC 2, SFNC 1, GigE Vision's own, and makers' earlier ones."""

from __future__ import annotations

import re

EXPOSURE = ("ExposureTime", "ExposureTimeAbs")
RATE = ("AcquisitionFrameRate", "AcquisitionFrameRateAbs", "FrameRate")
RATE_ENABLE = ("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled")
RESULTING_RATE = ("AcquisitionResultingFrameRate", "ResultingFrameRate", "ResultingFrameRateAbs")
GAIN = ("Gain", "GainRaw")
SOFTWARE_TRIGGER = ("TriggerSoftware", "SoftwareTrigger")
#: entries of TriggerSource for a trigger by command
SOFTWARE_SOURCE = ("Software", "SoftwareTrigger")
#: entries of TriggerSelector that start a frame, the plainest first
FRAME_START = ("FrameStart", "ExposureStart", "FrameBurstStart", "AcquisitionStart")
#: entries of TriggerSource for a trigger by action command, and the features that such a command must match
ACTION_SOURCE = re.compile("Action[0-9]+")
ACTION_KEYS = ("ActionDeviceKey", "ActionGroupKey", "ActionGroupMask")
TEMPERATURE = ("DeviceTemperature", "TemperatureAbs", "Temperature")
TEMPERATURE_SELECTOR = ("DeviceTemperatureSelector", "TemperatureSelector")
#: entries of the selector, from the sensor outwards
TEMPERATURE_PLACES = ("Sensor", "SensorBoard", "Sensorboard", "Coreboard", "Mainboard", "Main")

PTP_ENABLE = ("PtpEnable", "GevIEEE1588")
#: an enumeration in place of a switch: Off, Slave, Master, Auto
PTP_MODE = "PtpMode"
#: commands that bring the clock's data into the features that can be read
PTP_LATCH = ("PtpDataSetLatch", "GevIEEE1588DataSetLatch")
PTP_STATUS = ("GevIEEE1588StatusLatched", "PtpStatus", "GevIEEE1588Status")
PTP_MASTER_ID = (
    "PtpGrandmasterClockID",
    "PtpParentClockID",
    "GevIEEE1588ParentClockIdLatched",
    "GevIEEE1588ParentClockId",
)
PTP_OWN_ID = ("PtpClockID", "GevIEEE1588ClockIdLatched", "GevIEEE1588ClockId")
#: difference of the camera's clock from its master's, in ns
PTP_OFFSET = ("PtpOffsetFromMaster", "GevIEEE1588OffsetFromMaster")
#: commands that keep the clock's time of now, and the features that then hold it
TIMESTAMP_LATCH = (("TimestampLatch", "TimestampLatchValue"), ("GevTimestampControlLatch", "GevTimestampValue"))
TICK_FREQUENCY = "GevTimestampTickFrequency"
#: bytes a second that a camera sends at most, the switch that some have for it, and the older pause after each packet
THROUGHPUT_LIMIT = ("DeviceLinkThroughputLimit", "StreamBytesPerSecond")
THROUGHPUT_MODE = "DeviceLinkThroughputLimitMode"
PACKET_PAUSE = "GevSCPD"
#: speed of the camera's end of its link -> bytes a second of its unit
LINK_SPEED = {"DeviceLinkSpeed": 1.0, "GevLinkSpeed": 1e6 / 8}

#: enumerations that overrule a setting, and the entry that leaves it alone
BEFORE_EXPOSURE = {"ExposureAuto": "Off", "ExposureMode": "Timed"}

#: microseconds of the units of an exposure time; a description without a unit means microseconds
US_OF_UNIT = {
    "": 1.0,
    "us": 1.0,
    "µs": 1.0,
    "μs": 1.0,
    "usec": 1.0,
    "microseconds": 1.0,
    "ms": 1e3,
    "ns": 1e-3,
    "s": 1e6,
}
