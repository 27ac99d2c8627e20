"""Check of the cameras' viewing directions against the nominal ones."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.inputs import NominalValues
from stereorig.core.cameras.camera import angles_from_rotation
from stereorig.core.errors import CalibrationInputError

# at smaller differences the nominal angles are called right; they may be some degrees off
_TILT_NAMED_DEG = 10.0
# share of the angle between the optical axes: nominal angles are good to some degrees; a quarter turn of one image
# changes that angle by 30 % or the direction by 45 degrees
_BETWEEN_DEG, _BETWEEN_SHARE = 15.0, 0.35
_FLIP_DEG = 3.0  # largest difference of a flipped camera's alpha from the mirrored one of its partner


def check_angles(fitted: dict[str, Float], nominals: dict[str, NominalValues]) -> str:
    """Compare the fitted viewing directions with the nominal angles and between the cameras.

    A target that is tilted changes the directions of both cameras alike: they still see each other as declared. A
    turned or mirrored image changes the direction of the other camera as this camera sees it.

    Parameters
    ----------
    fitted
        ``cam_from_sys`` rotation (3, 3) per camera.
    nominals
        Nominal cameras.

    Returns
    -------
    str
        The finding in one sentence; it names a target's tilt.

    Raises
    ------
    CalibrationInputError
        ``cameras_swapped``, ``image_mirrored``, ``image_rotated`` or ``angle_mismatch``.
    """
    beta, gamma, nominal, alpha = {}, {}, {}, {}
    for name, R in fitted.items():
        a, b, g = (float(np.degrees(v)) for v in angles_from_rotation(R))
        alpha[name], beta[name], gamma[name], nominal[name] = a, b, g, nominals[name].placed()[1]
    found = ", ".join(f"{n} gamma {gamma[n]:+.1f} beta {beta[n]:+.1f} (nominal {nominal[n]:+.1f} and 0)" for n in gamma)
    context = {"gamma_deg": gamma, "beta_deg": beta, "nominal_deg": nominal}
    off = {n: abs(gamma[n] - nominal[n]) for n in gamma}
    if max(*off.values(), *map(abs, beta.values())) > _TILT_NAMED_DEG:
        if _as_declared(fitted, nominal):
            return _tilt_text(fitted, nominal)
        if _as_declared(fitted, {"cam1": nominal["cam2"], "cam2": nominal["cam1"]}):
            raise _swapped(found, context)
    for n in gamma:
        # a quarter turn of the image carries the tilt from gamma to beta
        if abs(nominal[n]) > 10.0 and abs(abs(beta[n]) - abs(nominal[n])) < 0.5 * abs(nominal[n]) > abs(gamma[n]):
            raise CalibrationInputError(
                f"{n} is tilted about its rows, not its columns: {found} degrees; its image seems turned by 90 "
                "degrees.",
                code="image_rotated",
                remedy="Mount the camera with its rows in the plane of both optical axes, or turn its images back.",
                camera=n,
                **context,
            )
    crossed = abs(gamma["cam1"] - nominal["cam2"]), abs(gamma["cam2"] - nominal["cam1"])
    # nominal angles may be 8 degrees off, but hardly so that exchanging them makes both fit
    if max(off.values()) > 5.0 and max(crossed) < (0.5 if max(off.values()) > 10.0 else 0.25) * max(off.values()):
        raise _swapped(found, context)
    if max(off.values()) > 10.0:
        for n in gamma:
            if off[n] > 10.0 and abs(gamma[n] + nominal[n]) < 0.5 * off[n]:
                raise CalibrationInputError(
                    f"{n} is tilted to the other side than declared: {found} degrees; its image seems mirrored or "
                    "turned by 180 degrees.",
                    code="image_mirrored",
                    remedy="Mirror or turn the camera's images back, or correct the sign of its nominal angle.",
                    camera=n,
                    **context,
                )
        worst = max(off, key=lambda n: off[n])
        if off[worst] > 20.0:
            raise CalibrationInputError(
                f"{worst} looks at the target from another angle than declared: {found} degrees.",
                code="angle_mismatch",
                remedy="Correct angle_deg of the rig, or check which camera took which image.",
                camera=worst,
                **context,
            )
    if max(abs(b) for b in beta.values()) > 25.0:
        worst = max(beta, key=lambda n: abs(beta[n]))
        raise CalibrationInputError(
            f"{worst} is tilted about its rows by {beta[worst]:+.1f} degrees: {found} degrees.",
            code="angle_mismatch",
            remedy="Set the target upright between the cameras, or check the mounting of the camera.",
            camera=worst,
            **context,
        )
    roll = abs((alpha["cam1"] - alpha["cam2"] + 180.0) % 360.0 - 180.0)
    # a flip takes alpha to 90 - alpha; cameras that are rolled against each other otherwise are no fault
    if roll > 25.0 and abs(alpha["cam1"] + alpha["cam2"] - 90.0) < _FLIP_DEG:
        raise CalibrationInputError(
            f"The grid is turned by {alpha['cam1']:+.1f} degrees in cam1 and {alpha['cam2']:+.1f} in cam2: one image "
            "seems flipped, or the cameras index different corners.",
            code="image_mirrored",
            remedy="Check that no image is flipped and that both cameras are mounted upright.",
            **context,
        )
    return "The viewing angles agree with the nominal ones and between the cameras."


def _swapped(found: str, context: dict[str, Any]) -> CalibrationInputError:
    return CalibrationInputError(
        f"The cameras seem swapped: {found} degrees.",
        code="cameras_swapped",
        remedy="Exchange the images or the nominal angles of cam1 and cam2 (or both images are mirrored).",
        **context,
    )


def _as_declared(fitted: dict[str, Float], nominal: dict[str, float]) -> bool:
    """Return True if each camera sees the other's optical axis in the direction declared.

    Index 2 of a camera's rotation is its optical axis in the target's frame.
    """
    one, two = fitted["cam1"], fitted["cam2"]
    between = nominal["cam1"] - nominal["cam2"]
    off = [
        abs(np.degrees(np.arctan2(x, z)) - expected) + abs(np.degrees(np.arcsin(y)))
        for (x, y, z), expected in ((one @ two[2], between), (two @ one[2], -between))
    ]
    return bool(max(off) < min(_BETWEEN_DEG, _BETWEEN_SHARE * abs(between)))


def _tilt_text(fitted: dict[str, Float], nominal: dict[str, float]) -> str:
    """Name the tilt of the target's plane by the mean of its normals in the frame of the nominal cameras."""
    normal = np.zeros(3)
    for name, R in fitted.items():
        turn = np.radians(nominal[name])
        x, y, z = R[:, 2]
        normal += [np.cos(turn) * x - np.sin(turn) * z, y, np.sin(turn) * x + np.cos(turn) * z]
    x, y, z = normal / np.linalg.norm(normal)
    tilt, rows, columns = np.degrees([np.arccos(z), np.arctan2(-y, z), np.arctan2(x, z)])
    return (
        f"The target is tilted by {tilt:.1f} degrees from the plane that the nominal angles declare, {rows:+.1f} about "
        f"the rows and {columns:+.1f} about the columns; the cameras see each other as declared."
    )


def check_order(fitted: dict[str, Float], nominals: dict[str, NominalValues]) -> None:
    """Compare the side of camera 2 with the nominal angles, for free poses, whose frame does not show it.

    Parameters
    ----------
    fitted
        ``cam_from_sys`` rotation (3, 3) per camera.
    nominals
        Nominal cameras; without angles nothing is compared.

    Raises
    ------
    CalibrationInputError
        ``cameras_swapped``.
    """
    one, two = nominals["cam1"].angle_deg, nominals["cam2"].angle_deg
    if one is None or two is None:
        return
    _, _, gamma = angles_from_rotation(fitted["cam2"] @ fitted["cam1"].T)
    found, nominal = float(np.degrees(gamma)), two - one
    if abs(nominal) > 5.0 and abs(found + nominal) < 0.5 * abs(found - nominal):
        raise CalibrationInputError(
            f"The cameras seem swapped: camera 2 is turned by {found:+.1f} degrees from camera 1, nominal are "
            f"{nominal:+.1f}.",
            code="cameras_swapped",
            remedy="Exchange the images or the nominal angles of cam1 and cam2.",
            found_deg=found,
            nominal_deg=nominal,
        )
