"""What a request's model writes of itself, with its defaults, is what its own schema allows: replies hand plans on."""

from __future__ import annotations

import jsonschema
import pytest
from pydantic import BaseModel

from stereorig.server.results.certificate.plan import CertificatePlan, KnownLength, ReferenceExtensometer

ENDS = {"a_px": [60.0, 80.0], "b_px": [160.0, 80.0]}
CHANNEL = ReferenceExtensometer.model_validate({**ENDS, "channel": "extensometer_mm"})
READ = ReferenceExtensometer.model_validate({**ENDS, "readings": [{"n": 1, "elongation_mm": 0.01}]})


@pytest.mark.parametrize(
    "asked",
    [
        CHANNEL,
        READ,
        CertificatePlan(extensometer=CHANNEL),
        KnownLength.model_validate({**ENDS, "name": "bar", "n": 1, "length_mm": 25.0}),
    ],
)
def test_a_plan_as_written_fits_its_schema(asked: BaseModel) -> None:
    jsonschema.validate(asked.model_dump(mode="json"), type(asked).model_json_schema())


def test_both_forms_do_not_fit() -> None:
    both = {**READ.model_dump(mode="json"), "channel": "extensometer_mm"}
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(both, ReferenceExtensometer.model_json_schema())
