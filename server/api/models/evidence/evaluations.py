"""Evaluations, as they travel."""

from __future__ import annotations

from pydantic import Field
from pydantic.json_schema import JsonSchemaValue

from stereorig.server.base.models import Listing, Reply, Request
from stereorig.server.store.models import ModelRecord


class EvaluationRequest(Request):
    """Settings of an evaluation."""

    settings: dict[str, object] = Field(
        default_factory=dict,
        description="As the evaluation's `settings` in the list of evaluations describes them.",
        examples=[{"variable": "w_mm", "upper": 0.1}],
        max_length=200,
    )


class EvaluationReply(Reply):
    """Answer of an evaluation."""

    name: str = Field(description="The evaluation.", examples=["conformity"])
    document: dict[str, object] = Field(description="As the evaluation's `document` in the list describes it.")


class EvaluationEntry(Reply):
    """An evaluation that is installed."""

    name: str = Field(description="Name in addresses and on the command line.", examples=["conformity"])
    title: str = Field(description="Name for people; empty if it does not load.", examples=["Conformity with limits"])
    needs: list[str] = Field(description="Variables that the steps must have.", examples=[["w_mm"]])
    settings: JsonSchemaValue = Field(description="JSON schema of its settings.")
    document: JsonSchemaValue = Field(description="JSON schema of its document.")
    package: str = Field(description="Package and version that it comes from.", examples=["stereorig 0.3.0"])
    problem: str = Field(description="Reason why it cannot be used; empty if it can.")


class EvaluationList(Reply):
    """Every evaluation that is installed."""

    evaluations: list[EvaluationEntry] = Field(description="By name.")


# Models of a test.


class ModelList(Listing):
    """Models, oldest first."""

    models: list[ModelRecord] = Field(description="Each with its reading options and its placement.")
