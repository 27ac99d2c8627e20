"""The examination: everything that a rig file names, one part after the other, each in spite of the others' faults."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

from stereorig.core.errors import StereorigError
from stereorig.core.names import CAMERAS
from stereorig.drivers.stages.serial_ports import port_problem
from stereorig.server.config.rig_file import RigConfig, load_config
from stereorig.server.doctor.access import check_cell, check_service_port, check_usb_cameras
from stereorig.server.doctor.cameras import check_frames, check_identity, check_pairs, check_ptp, check_settings, watch
from stereorig.server.doctor.disk import check_disk
from stereorig.server.doctor.link import check_link, check_network
from stereorig.server.doctor.machine import ClockWatch, check_kernels, check_machine, check_software
from stereorig.server.doctor.report import AllChecks, Check, Notebook
from stereorig.server.doctor.stage import check_stage
from stereorig.server.formats.version import software_version
from stereorig.server.rig.build import (
    Devices,
    check_config,
    first_settings,
    make_unit,
    open_configured_stage,
    open_devices,
)
from stereorig.server.rig.devices import DeviceFinder, DeviceListing, is_called


def examine(
    path: Path,
    *,
    seconds: float = 5.0,
    data: Path = Path("data"),
    host: str = "127.0.0.1",
    port: int = 8000,
    move: bool = False,
    home: bool = False,
    record: Path | None = None,
    on_check: Callable[[Check], None] | None = None,
) -> AllChecks:
    """Examine the bench that a rig file names.

    Parameters
    ----------
    path
        The rig file.
    seconds
        How long pairs are captured for.
    data
        The data folder, whose disk is timed.
    host, port
        Where the service is to listen.
    move, home
        Allow a small move of each axis, and the search for home; a simulated stage does both anyway.
    record
        File that gets a transcript of the stage's wire.
    on_check
        Called with each check as it is made.
    """
    book = Notebook(on_check)
    clock = ClockWatch()
    check_software(book)
    check_kernels(book)
    check_machine(book)
    check_service_port(book, host, port)
    check_cell(book)
    config = _read(book, path)
    if config is not None:
        _check_drivers(book, config)
        for line in [] if config.stage is None else config.stage.lines(config.axes):
            _check_port(book, line.url)
        _check_devices(book, config, seconds, move=move, home=home, record=record)
    # under software triggers pairs come as they are asked for: there is no rate to keep up with
    rate = None if config is None else config.rig.frame_rate_hz
    columns, rows = (1024, 1024) if config is None else config.cam1.image_size_px
    wide = 1 if config is None or config.cam1.bit_depth == 8 else 2
    check_disk(book, data, image_bytes=columns * rows * wide, pairs_per_s=rate)
    clock.check(book)
    good, verdict = book.verdict()
    return AllChecks(
        version=software_version(),
        rig=None if config is None else config.rig.name,
        config=str(path),
        seconds=seconds,
        checks=book.checks,
        good=good,
        verdict=verdict,
    )


def _read(book: Notebook, path: Path) -> RigConfig | None:
    try:
        config = load_config(path)
        check_config(config)
    except StereorigError as error:
        book.fail("rig file", "reading", error)
        return None
    book.note("rig file", "reading", "ok", f"{path}: {config.rig.name} ({config.rig.kind})")
    return config


def _check_drivers(book: Notebook, config: RigConfig) -> None:
    """See whether the rig file's drivers work here and see its cameras."""
    wanted = {config.camera(cam).driver for cam in CAMERAS} - {"sim"}
    if not wanted:
        book.note("software", "camera drivers", "ok", "simulated cameras need none")
        return
    if "aravis" in wanted:
        check_usb_cameras(book)
    listing = DeviceFinder(wanted).find()
    for driver in listing.drivers:
        if driver.name in wanted:
            book.note(
                "software",
                f"driver {driver.name}",
                "ok" if driver.state == "ok" else "failed",
                driver.problem or f"sees {driver.found} cameras",
                remedy=driver.remedy,
            )
    searched = {driver.name for driver in listing.drivers if driver.state == "ok"}
    for cam in CAMERAS:
        if config.camera(cam).driver in searched:
            _check_found(book, cam, config, listing)


def _check_port(book: Notebook, url: str) -> None:
    """Note the reasons for which a serial port of this machine cannot be used."""
    if url.startswith("/"):
        problem = port_problem(url)
        book.note(
            "stage",
            "port",
            "failed" if problem else "ok",
            problem or f"{url} is there, free and ours to use",
            remedy="'stereorig devices' lists the serial ports of this machine.",
        )


def _check_found(book: Notebook, cam: str, config: RigConfig, listing: DeviceListing) -> None:
    section = config.cam1 if cam == "cam1" else config.cam2
    named = section.device or ""
    for found in listing.cameras:
        if found.driver == section.driver and is_called(found, named):
            book.note(cam, "found", "failed" if found.problem else "ok", found.problem or f"{named}: {found.model}")
            return
    others = ", ".join(camera.device for camera in listing.cameras) or "none"
    book.note(
        cam,
        "found",
        "warning",
        f"{named or 'no device'} does not show itself; the driver sees: {others}",
        remedy="Check power and cable, and the name in the rig file; see 'stereorig devices'.",
    )


def _check_devices(
    book: Notebook, config: RigConfig, seconds: float, *, move: bool, home: bool, record: Path | None
) -> None:
    settings = {cam: first_settings(config, cam) for cam in CAMERAS}
    try:
        devices = open_devices(config, settings, record=record)
    except StereorigError as error:
        _check_each(book, config, error, move=move, home=home, record=record)
        return
    with contextlib.closing(devices):
        _check_cameras(book, devices, config, seconds)
        # a rig with simulated cameras may still have a real stage
        simulated = devices.controller is not None
        if config.stage is not None:
            check_stage(book, devices.stage, config, move=move or simulated, home=home or simulated)


def _check_each(
    book: Notebook, config: RigConfig, error: StereorigError, *, move: bool, home: bool, record: Path | None
) -> None:
    """Find out which devices are well when they cannot be opened all together."""
    if config.rig.kind == "simulated":
        book.fail(str(error.context.get("camera", "devices")), "opening", error)
        return
    for cam in CAMERAS:
        unit = make_unit(config, cam)
        with book.guard(cam, "opening"), contextlib.closing(unit):
            unit.open(first_settings(config, cam))
            book.note(cam, "opening", "ok", f"{unit.description.model} {unit.description.serial}")
            check_settings(book, unit)
    bad = [check for check in book.checks if check.state == "failed" and check.name == "opening"]
    if any("camera_busy" in check.found for check in bad):
        # over a network a controller takes several programs at once, and the other program may be about to move it
        book.note(
            "stage",
            "opening",
            "not checked",
            "another program uses the cameras, and perhaps the stage",
            remedy="End that program, then run the doctor again.",
        )
    elif config.stage_is_simulated:
        book.note("stage", "opening", "not checked", "a simulated stage runs with the whole rig only")
    elif config.stage is not None:
        with book.guard("stage", "opening"):
            stage = open_configured_stage(config, record=record)
            with contextlib.closing(stage):
                check_stage(book, stage, config, move=move, home=home)
    if not any(check.state == "failed" and check.name == "opening" for check in book.checks):
        book.fail("devices", "opening", error)  # each is well alone
    book.note(
        "pairs",
        "frames",
        "not checked",
        "not all devices could be opened",
        remedy="Put the failed parts right, then run the doctor again.",
    )


def _check_cameras(book: Notebook, devices: Devices, config: RigConfig, seconds: float) -> None:
    pair = devices.pair
    check_identity(book, pair)
    for cam in CAMERAS:
        check_settings(book, pair.units[cam])
    try:
        seen = watch(pair, seconds)
    except StereorigError as error:
        book.fail(str(error.context.get("camera", "pairs")), "frames", error)
        return
    for cam in CAMERAS:
        check_frames(book, pair.units[cam], seen)
        check_link(book, pair.units[cam], seen)
    check_network(book, pair.units, seen)
    if config.cam1.ptp and config.cam2.ptp:
        check_ptp(book, pair)
    check_pairs(book, seen, config)
