"""Controls of a device by name: their ranges, and their values as set and read back.

V4L2 clamps in silence: a value out of range, off the step or no item of a menu is therefore refused here, before
anything is written, and each control is read back after it was written.
"""

from __future__ import annotations

import ctypes
import errno
from dataclasses import dataclass

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.protocol import FeatureValue
from stereorig.drivers.cameras.v4l2 import structures as v
from stereorig.drivers.cameras.v4l2.device import V4l2Device

_NUMBERS = (v.CTRL_TYPE_INTEGER, v.CTRL_TYPE_INTEGER64, v.CTRL_TYPE_BITMASK)
_MENUS = (v.CTRL_TYPE_MENU, v.CTRL_TYPE_INTEGER_MENU)
_READABLE = (*_NUMBERS, *_MENUS, v.CTRL_TYPE_BOOLEAN, v.CTRL_TYPE_STRING)

Raw = int | str


def control_name(text: str) -> str:
    """Spell a control's title as the kernel's tools do: ``Exposure, Auto`` is ``exposure_auto``."""
    letters = "".join(c.lower() if c.isascii() and c.isalnum() else " " for c in text)
    return "_".join(letters.split())


@dataclass(frozen=True)
class Control:
    """One control as the device describes it now; its range and flags may change with other settings."""

    number: int
    name: str
    kind: int
    lowest: int
    highest: int
    step: int
    flags: int
    size: int

    @property
    def is_button(self) -> bool:
        """True if it is pressed rather than set."""
        return self.kind == v.CTRL_TYPE_BUTTON

    @property
    def settable(self) -> bool:
        """True if a setting may name it."""
        return (self.is_button or self.kind in _READABLE) and not self.flags & v.CTRL_FLAG_READ_ONLY


class Controls:
    """All controls of one device."""

    def __init__(self, device: V4l2Device) -> None:
        self._device = device
        self._numbers: dict[str, int] = {}
        number = 0
        while True:
            query = v.QueryExtCtrl(id=number | v.CTRL_FLAG_NEXT_CTRL)
            try:
                device.ioctl(v.VIDIOC_QUERY_EXT_CTRL, query)
            except OSError as error:
                if error.errno in (errno.EINVAL, errno.ENOTTY):
                    break
                raise device.fault(error, "list its controls") from error
            number = query.id
            control = _described(query)
            if query.flags & v.CTRL_FLAG_DISABLED or not (control.is_button or control.kind in _READABLE):
                continue
            # two controls of one title: the later ones carry their number
            name = control.name if control.name not in self._numbers else f"{control.name}_0x{number:08x}"
            self._numbers[name] = number

    @property
    def settable_names(self) -> tuple[str, ...]:
        """Names that a setting may have."""
        return tuple(name for name in self._numbers if self.find(name).settable)

    def find(self, name: str) -> Control:
        """Describe a control as it is now; code ``unknown_feature`` if there is none of this name."""
        if name not in self._numbers:
            raise CameraError(
                f"{self._device.path} has no control {name!r}.",
                code="unknown_feature",
                remedy=f"It has: {', '.join(self._numbers) or 'none'}.",
                device=self._device.path,
                setting=name,
            )
        found = self.by_number(self._numbers[name])
        if found is None:
            raise CameraError(f"{self._device.path} no longer has its control {name!r}.", setting=name)
        return found

    def by_number(self, number: int) -> Control | None:
        """Describe a control by its ``V4L2_CID_`` number; ``None`` if the device has none."""
        query = v.QueryExtCtrl(id=number)
        try:
            self._device.ioctl(v.VIDIOC_QUERY_EXT_CTRL, query)
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY):
                return None
            raise self._device.fault(error, "describe a control") from error
        return None if query.flags & v.CTRL_FLAG_DISABLED else _described(query)

    def items(self, control: Control) -> dict[int, str]:
        """Items of a menu by their number; menus may have gaps."""
        found = {}
        for index in range(control.lowest, control.highest + 1):
            query = v.QueryMenu(id=control.number, index=index)
            try:
                self._device.ioctl(v.VIDIOC_QUERYMENU, query)
            except OSError as error:
                if error.errno == errno.EINVAL:
                    continue
                raise self._device.fault(error, f"list the items of {control.name}") from error
            if control.kind == v.CTRL_TYPE_MENU:
                found[index] = query.u.name.decode("utf-8", "replace")
            else:
                found[index] = str(query.u.value)
        return found

    def check(self, name: str, value: FeatureValue) -> tuple[Control, Raw]:
        """Convert a value for a control without setting it.

        Raises
        ------
        CameraError
            ``unknown_feature``; ``read_only``; ``out_of_range`` with the allowed values.
        """
        control = self.find(name)
        if not control.settable:
            raise CameraError(
                f"{self._device.path} reports {name} but does not let it be set.",
                code="read_only",
                remedy="Leave it out of the settings.",
                device=self._device.path,
                setting=name,
            )
        raw = self._understood(control, value)
        if raw is None:
            raise self.out_of_range(name, value, self._allowed(control))
        return control, raw

    def _understood(self, control: Control, value: FeatureValue) -> Raw | None:
        if control.is_button:
            return 0 if value is True or value == 1 else None
        if control.kind == v.CTRL_TYPE_STRING:
            if not isinstance(value, str):
                return None
            length = len(value.encode("utf-8"))
            fits = control.lowest <= length <= control.highest and (length - control.lowest) % max(control.step, 1) == 0
            return value if fits and "\0" not in value else None
        if control.kind in _MENUS:
            return self._item(self.items(control), value)
        if isinstance(value, str) or value != value or value in (float("inf"), float("-inf")) or int(value) != value:
            return None
        if isinstance(value, bool) and control.kind != v.CTRL_TYPE_BOOLEAN:
            return None
        raw = int(value)
        if control.kind == v.CTRL_TYPE_BITMASK:
            # the kernel keeps a mask of 32 bits in a signed number
            return raw if raw >= 0 and not raw & ~(control.highest & 0xFFFF_FFFF) else None
        in_range = control.lowest <= raw <= control.highest and (raw - control.lowest) % max(control.step, 1) == 0
        return raw if in_range else None

    @staticmethod
    def _item(items: dict[int, str], value: FeatureValue) -> int | None:
        if isinstance(value, str):
            return next((i for i, text in items.items() if text.casefold() == value.strip().casefold()), None)
        if isinstance(value, bool):
            return None
        return next((index for index in items if index == value), None)

    def _allowed(self, control: Control) -> str:
        if control.is_button:
            return "true, to press it"
        if control.kind in _MENUS:
            return ", ".join(f"{index} ({text})" for index, text in self.items(control).items())
        if control.kind == v.CTRL_TYPE_STRING:
            return f"text of {control.lowest} to {control.highest} bytes"
        if control.kind == v.CTRL_TYPE_BITMASK:
            return f"bits of 0x{control.highest & 0xFFFF_FFFF:x}"
        steps = f" in steps of {control.step}" if control.step > 1 else ""
        return f"{control.lowest} to {control.highest}{steps}"

    def out_of_range(self, name: str, value: object, allowed: str) -> CameraError:
        """Return the error for a value that the device cannot take."""
        return CameraError(
            f"{self._device.path} cannot set {name} to {value!r}, only {allowed}.",
            code="out_of_range",
            remedy="Give a value in the range above.",
            device=self._device.path,
            setting=name,
        )

    def put(self, control: Control, raw: Raw, *, exact: bool = True) -> None:
        """Write a checked value and read it back.

        Parameters
        ----------
        control, raw
            As `check` returned them.
        exact
            True if another value afterwards is an error; False leaves it for the caller to read.

        Raises
        ------
        CameraError
            ``setting_not_taken`` when the device has another value afterwards, or reports that the control has no
            effect at present; ``armed`` when it cannot be changed while frames come.
        """
        try:
            self._exchange(v.VIDIOC_S_EXT_CTRLS, control, raw)
        except OSError as error:
            raise self._unwritten(control, raw, error) from error
        if control.is_button or control.flags & v.CTRL_FLAG_WRITE_ONLY:
            return
        now = self.by_number(control.number) or control
        if now.flags & v.CTRL_FLAG_INACTIVE:
            raise self._not_taken(
                control,
                f"holds {control.name} = {raw!r} without effect, since another setting overrides it",
                "Switch off what sets it by itself (automatic exposure, gain, white balance, focus) first.",
            )
        if control.flags & v.CTRL_FLAG_VOLATILE:
            return  # the device changes it by itself: the value read back is not the one set
        taken = self.get(control)
        if exact and taken != raw:
            raise self._not_taken(
                control,
                f"was asked for {control.name} = {raw!r} and has {taken!r}",
                f"Ask for {taken!r}, or leave {control.name} out.",
            )

    def get(self, control: Control) -> Raw | None:
        """Read a control's value; ``None`` if it cannot be read."""
        if control.is_button or control.flags & v.CTRL_FLAG_WRITE_ONLY:
            return None
        try:
            return self._exchange(v.VIDIOC_G_EXT_CTRLS, control, None)
        except OSError as error:
            if error.errno in (errno.ENODEV, errno.ENXIO):
                raise self._device.fault(error, f"read {control.name}") from error
            return None

    def as_asked(self, control: Control, raw: Raw | None, like: FeatureValue) -> FeatureValue | None:
        """Write a value the way the caller wrote his: the text of a menu's item, true and false."""
        if raw is None or isinstance(raw, str):
            return raw
        if control.kind == v.CTRL_TYPE_BOOLEAN:
            return bool(raw)
        if control.kind in _MENUS and isinstance(like, str):
            return self.items(control).get(raw, str(raw))
        return raw

    def _exchange(self, request: int, control: Control, raw: Raw | None) -> Raw:
        one = v.ExtControl(id=control.number)
        text: ctypes.Array[ctypes.c_char] | None = None
        if control.kind == v.CTRL_TYPE_STRING:
            encoded = raw.encode("utf-8") if isinstance(raw, str) else b""
            text = ctypes.create_string_buffer(encoded, max(control.size, control.highest + 1, len(encoded) + 1))
            one.size = len(text)
            one.u.string = ctypes.addressof(text)
        elif control.kind == v.CTRL_TYPE_INTEGER64:
            one.u.value64 = int(raw or 0)
        else:
            one.u.value = ctypes.c_int32(int(raw or 0)).value
        # a class of 0 takes controls of any class, and their current values
        many = v.ExtControls(which=v.CTRL_WHICH_CUR_VAL, count=1, controls=ctypes.pointer(one))
        self._device.ioctl(request, many)
        if text is not None:
            return text.value.decode("utf-8", "replace")
        if control.kind == v.CTRL_TYPE_INTEGER64:
            return one.u.value64
        return one.u.value & 0xFFFF_FFFF if control.kind == v.CTRL_TYPE_BITMASK else one.u.value

    def _unwritten(self, control: Control, raw: Raw, error: OSError) -> CameraError:
        if error.errno in (errno.ENODEV, errno.ENXIO, errno.ESHUTDOWN):
            return self._device.fault(error, f"set {control.name}")
        if error.errno == errno.EBUSY:
            return CameraError(
                f"{self._device.path} cannot change {control.name} now ({error.strerror}).",
                code="armed",
                remedy="Stop the cameras first; if they stand still, another program uses this one.",
                device=self._device.path,
                setting=control.name,
            )
        return self._not_taken(
            control,
            f"refused {control.name} = {raw!r} ({error.strerror})",
            "Leave it out, or switch off what sets it by itself first.",
        )

    def _not_taken(self, control: Control, failure: str, remedy: str) -> CameraError:
        return CameraError(
            f"{self._device.path} {failure}.",
            code="setting_not_taken",
            remedy=remedy,
            device=self._device.path,
            setting=control.name,
        )


def _described(query: v.QueryExtCtrl) -> Control:
    return Control(
        number=query.id,
        name=control_name(query.name.decode("utf-8", "replace")),
        kind=query.type,
        lowest=query.minimum,
        highest=query.maximum,
        step=query.step,
        flags=query.flags,
        size=query.elem_size,
    )
