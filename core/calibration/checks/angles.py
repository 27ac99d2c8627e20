"""Check of the cameras' viewing directions against the nominal ones."""

from __future__ import annotations

import numpy as np

from core.arrays import Float
from core.calibration.inputs import NominalCamera
from core.cameras.camera import angles_from_rotation
from core.errors import CalibrationInputError

_FLIP_DEG = 3.0  # largest difference of a flipped camera's alpha from the mirrored one of its partner


def check_angles(fitted: dict[str, Float], nominals: dict[str, NominalCamera]) -> None:
    """Compare the fitted viewing directions with the nominal angles and between the cameras.

    Parameters
    ----------
    fitted
        ``cam_from_sys`` rotation (3, 3) per camera.
    nominals
        Nominal cameras.

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
        raise CalibrationInputError(
            f"The cameras seem swapped: {found} degrees.",
            code="cameras_swapped",
            remedy="Exchange the images or the nominal angles of cam1 and cam2 (or both images are mirrored).",
            **context,
        )
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


def check_order(fitted: dict[str, Float], nominals: dict[str, NominalCamera]) -> None:
    """Compare the side of camera 2 with the nominal angles, where poses are free and the target's frame says nothing.

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
