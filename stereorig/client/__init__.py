"""The service from Python: :class:`stereorig.Client` and :class:`stereorig.AsyncClient`, and the forms of what is sent.

What the methods take and return are the models of the API; a parameter, its bounds and its default stand there once.
"""

from server.api.models import (
    AnalysisReply,
    AnalysisRequest,
    CalibrationReply,
    CalibrationRequest,
    GaugesReply,
    JobReply,
    MoveRequest,
    Region,
    RigReply,
    SceneRequest,
    StepReply,
    StepRequest,
    TestReply,
    TestRequest,
)
from server.results.gauges.request import GaugeRequest
from stereorig.client.asynchronous import AsyncAnalysis, AsyncClient, AsyncTest
from stereorig.client.synchronous import Analysis, Client, Test

__all__ = [
    "Analysis",
    "AnalysisReply",
    "AnalysisRequest",
    "AsyncAnalysis",
    "AsyncClient",
    "AsyncTest",
    "CalibrationReply",
    "CalibrationRequest",
    "Client",
    "GaugeRequest",
    "GaugesReply",
    "JobReply",
    "MoveRequest",
    "Region",
    "RigReply",
    "SceneRequest",
    "StepReply",
    "StepRequest",
    "Test",
    "TestReply",
    "TestRequest",
]
