"""Lens models as unknowns of the adjustment: names, start values, priors, and the lens that a set of numbers means.

The numbers of a lens are its pinhole distance along the rows, its centre, its distortion, and last the aspect ratio
(rows' scale over columns' scale), which a motion along one axis does not show and which is then held.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.lens import LensModel, OpenCVLens, SeidelLens
from stereorig.core.cameras.opencv_full import PRISM_TERMS, TILT_TERMS, OpenCVFullLens

LensName = Literal[
    "paper", "opencv5", "opencv8", "opencv5_prism", "opencv5_tilted", "opencv5_prism_tilted", "opencv12", "opencv14"
]
LENS_NAMES: tuple[LensName, ...] = get_args(LensName)
LensChoice = Literal["auto"] | LensName
LENS_CHOICES: tuple[LensChoice, ...] = ("auto", *LENS_NAMES)

_FIVE = ("k1", "k2", "p1", "p2", "k3")
_EIGHT = (*_FIVE, "k4", "k5", "k6")
_DISTORTION: dict[LensName, tuple[str, ...]] = {
    "paper": ("kappa_per_px2",),
    "opencv5": _FIVE,
    "opencv8": _EIGHT,
    "opencv5_prism": (*_FIVE, "s1", "s3"),
    "opencv5_tilted": (*_FIVE, *TILT_TERMS),
    "opencv5_prism_tilted": (*_FIVE, "s1", "s3", *TILT_TERMS),
    "opencv12": (*_EIGHT, *PRISM_TERMS),
    "opencv14": (*_EIGHT, *PRISM_TERMS, *TILT_TERMS),
}
# standard deviation of a term's shift of the image's corner, relative to its distance from the centre: far larger than
# in any lens used for measuring, and a limit if the views do not show the term at all
_RADIAL_SHARE, _DECENTRING_SHARE = 0.5, 0.05
_POWERS = {"kappa_per_px2": 2, "k1": 2, "k2": 4, "k3": 6, "k4": 2, "k5": 4, "k6": 6}
_DECENTRING_POWERS = {"p1": 1, "p2": 1, "s1": 1, "s2": 3, "s3": 1, "s4": 3}
_TILT_SIGMA_RAD = 0.1  # a sensor is mounted to some hundredths, an adapter for tilted focus turns it by up to 0.3


@dataclass(frozen=True)
class LensForm:
    """One lens model as unknowns.

    Attributes
    ----------
    model
        Name of the model.
    """

    model: LensName

    @property
    def distortion_names(self) -> tuple[str, ...]:
        """Names of the distortion's terms."""
        return _DISTORTION[self.model]

    @property
    def size(self) -> int:
        """Number of unknowns: pinhole distance, centre, distortion, aspect ratio."""
        return 4 + len(self.distortion_names)

    @property
    def aspect_index(self) -> int:
        """Index of the aspect ratio, the last."""
        return self.size - 1

    def start(self, focal_px: float, centre_px: tuple[float, float], aspect: float) -> Float:
        """Return the numbers (n,) of a lens without distortion."""
        return np.array([focal_px, *centre_px, *(0.0 for _ in self.distortion_names), aspect])

    def converted(self, values: Float, other: LensForm) -> Float:
        """Return the nearest numbers in another model, (m,)."""
        mine = dict(zip(self.distortion_names, values[3:-1], strict=True))
        if "kappa_per_px2" in mine:
            mine["k1"] = -mine["kappa_per_px2"] * values[0] ** 2
        else:
            mine["kappa_per_px2"] = -mine["k1"] / values[0] ** 2
        return np.array([*values[:3], *(float(mine.get(n, 0.0)) for n in other.distortion_names), values[-1]])

    def lens(self, values: Float) -> LensModel:
        """Return the lens that the numbers (n,) mean."""
        focal, cx, cy, aspect = (float(values[k]) for k in (0, 1, 2, -1))
        terms = {n: float(v) for n, v in zip(self.distortion_names, values[3:-1], strict=True)}
        if self.model == "paper":
            return SeidelLens(focal, cx, cy, terms["kappa_per_px2"], aspect)
        kind = OpenCVFullLens if terms.keys() & {*PRISM_TERMS, *TILT_TERMS} else OpenCVLens
        return kind(focal, focal * aspect, cx, cy, **terms)

    def names(self, *, aspect_estimated: bool) -> tuple[str, ...]:
        """Names of the lens's own parameters that are estimated, as its class spells them."""
        if self.model == "paper":
            return ("phd_px", "cx_px", "cy_px", "kappa_per_px2", *(("aspect",) if aspect_estimated else ()))
        return ("fx_px", "fy_px", "cx_px", "cy_px", *self.distortion_names)

    def to_names(self, values: Float, *, aspect_estimated: bool) -> Float:
        """Derivatives (names, n) of the parameters in :meth:`names` over the unknowns."""
        n = self.size
        if self.model == "paper":
            return np.eye(n)[: n if aspect_estimated else n - 1]
        out = np.zeros((n, n))
        out[0, 0] = 1.0
        out[1, 0], out[1, -1] = values[-1], values[0]  # fy = aspect fx
        out[2:, 1:-1] = np.eye(n - 2)
        return out

    def jacobian(self, lens: LensModel, values: Float, xy_norm: Float) -> Float:
        """Derivatives (..., 2, n) of the image over the unknowns, at normalised points (..., 2)."""
        full = lens.parameter_jacobian(xy_norm)
        if self.model == "paper":
            return full  # phd, cx, cy, kappa, aspect
        columns = [lens.parameter_names.index(name) for name in self.distortion_names]
        out = np.empty((*full.shape[:-1], self.size))
        out[..., 0] = full[..., 0] + values[-1] * full[..., 1]
        out[..., 1:3] = full[..., 2:4]
        out[..., 3:-1] = full[..., columns]
        out[..., -1] = values[0] * full[..., 1]
        return out

    def prior_sigma(self, image_size_px: tuple[int, int], focal_px: float, *, centre_px: float, aspect: float) -> Float:
        """Prior standard deviations (n,) of the unknowns; infinite without one, zero where held."""
        corner_px = 0.5 * float(np.hypot(*image_size_px))
        corner = corner_px / focal_px
        sigma = [np.inf, centre_px, centre_px]
        for name in self.distortion_names:
            if name in _DECENTRING_POWERS:
                sigma.append(_DECENTRING_SHARE / corner ** _DECENTRING_POWERS[name])
            elif name in TILT_TERMS:
                sigma.append(_TILT_SIGMA_RAD)
            elif name == "kappa_per_px2":
                sigma.append(_RADIAL_SHARE / corner_px**2)
            else:
                sigma.append(_RADIAL_SHARE / corner ** _POWERS[name])
        return np.array([*sigma, aspect])
