"""The profile of a ground steel plate: section 5.3 of the paper."""

from __future__ import annotations

import numpy as np

from stereorig.server.demo.compare import compare_shape, heights_mm
from stereorig.server.demo.drawing import fields as pictures
from stereorig.server.demo.drawing import gauges
from stereorig.server.demo.experiments import steel_motion
from stereorig.server.demo.session import DemoCheck, DemoRun, Outcome, pixels_of, table
from stereorig.sim.catalog import make_scene
from stereorig.sim.truth import subset_planes

ROI_PX = (56.0, 85.0, 456.0, 395.0)  # 400 x 310 px, as in the paper
SUBSET_PX, SPACING_PX = 21, 15  # 27 x 21 = 567 points; the paper has 566
MOTION_STEP_PX = 10
CAPTURES = 5  # one is the measurement, all of them determine its noise
LIMIT_PERCENT = 3.0


def run(session: DemoRun, calibration_id: str) -> Outcome:
    """Capture the steel plate, measure its profile, take out the noise floor, compare."""
    client = session.client
    client.set_scene("steel")
    test = client.create_test("Ground steel plate", calibration_id, "Ra 1.775 um")
    for n in range(CAPTURES):
        client.capture(test, "the pair" if n == 0 else f"once more, for the noise ({n})")
    steel_motion.capture(session, test)
    session.note(f"captured {CAPTURES} pairs of the plate at rest, {len(steel_motion.MOTIONS)} of it moved")
    # plane patches: the truth below is the surface as a plane of the subset's size sees it
    analysis = client.analyse(
        test,
        "profile",
        {"rectangle": list(ROI_PX)},
        subset_px=SUBSET_PX,
        spacing_px=SPACING_PX,
        patch="affine",
        steps=list(range(CAPTURES)),
    )
    fields = session.fetch(analysis, range(CAPTURES))

    use = np.logical_and.reduce([f.valid for f in fields])
    found_um = 1e3 * np.stack([heights_mm(f.xyz_mm, use) for f in fields])
    scene, camera = make_scene(session.rig, "steel"), session.rig.cam1.camera
    seen = subset_planes(scene, camera, pixels_of(fields[0]).reshape(-1, 2), SUBSET_PX)
    true_um = 1e3 * heights_mm(seen.xyz_mm.reshape(*use.shape, 3), use)

    # noise changes from capture to capture, the surface does not
    noise_um = float(np.sqrt(np.nanmean(np.nanvar(found_um[:, use], axis=0, ddof=1))))
    mean_um = float(np.mean(np.abs(found_um[0][use])))
    rms_um = float(np.sqrt(np.mean(found_um[0][use] ** 2)))
    # mean and rms of heights shrink alike when independent noise is taken out of their variance
    clean_um = mean_um * float(np.sqrt(max(0.0, 1.0 - (noise_um / rms_um) ** 2)))
    truth_um = float(np.mean(np.abs(true_um[use])))
    percent = 100.0 * (clean_um / truth_um - 1.0)
    wrong = sum(int(compare_shape(f, session.rig, "steel").sum()) for f in fields)

    outcome = Outcome()
    outcome.checks = [
        DemoCheck(
            "mean deviation from the best plane, noise taken out", "um", clean_um, truth_um, percent, LIMIT_PERCENT, "%"
        ),
        DemoCheck("wrong points among the valid", "points", wrong, None, wrong, 0),
    ]
    rows = [
        ["mean deviation, one pair", f"{mean_um:.3f}", ""],
        ["noise floor, sd (repeated pairs)", f"{noise_um:.3f}", ""],
        ["mean deviation, noise taken out", f"{clean_um:.3f}", f"{truth_um:.3f}"],
    ]
    outcome.lines = [
        *table(["", "found um", "true um"], rows),
        "",
        f"against the surface as a {SUBSET_PX} px subset sees it: {percent:+.2f} % ({int(use.sum())} points; "
        f"the surface itself has Ra 1.775 um)",
        f"wrong points among {sum(int(f.valid.sum()) for f in fields)} valid ones: {wrong}",
    ]
    image = session.reference_image(test)
    outcome.pictures = pictures.steel(session.out, image, ROI_PX, fields[0], found_um[0], true_um)
    outcome.data = {
        "points": int(use.sum()),
        "mean_um": mean_um,
        "noise_um": noise_um,
        "clean_um": clean_um,
        "true_um": truth_um,
        "correlation_with_truth": float(np.corrcoef(found_um[0][use], true_um[use])[0, 1]),
    }
    moved, moved_fields, strains = steel_motion.measure(
        session,
        test,
        CAPTURES,
        {"rectangle": list(ROI_PX)},
        "results_moved",
        subset_px=SUBSET_PX,
        spacing_px=MOTION_STEP_PX,
    )
    steel_motion.add_checks(outcome, moved, strains)
    outcome.pictures |= gauges.moved(session.out, moved_fields, strains, moved)
    return outcome
