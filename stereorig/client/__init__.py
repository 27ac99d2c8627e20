"""The service from Python: :class:`stereorig.Client` and :class:`stereorig.AsyncClient`, and their requests' models.

The methods take and return the models of the API, which define each parameter, its bounds and its default once.
"""

from stereorig.client.asynchronous import AsyncAnalysis, AsyncClient, AsyncTest
from stereorig.client.synchronous import Analysis, Client, Test
from stereorig.server.api.models import (
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
from stereorig.server.results.gauges.request import GaugeRequest

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
