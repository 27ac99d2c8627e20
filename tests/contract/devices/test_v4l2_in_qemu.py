"""The V4L2 driver against the kernel's vivid driver: every test that runs in the guest is a test here, by its own name.

One boot runs them all; see `v4l2_guest`. What is skipped in the guest is skipped here with the same words.
"""

from __future__ import annotations

import pytest

from tests.support.requirements import missing
from tests.support.v4l2_guest import Missing, Outcome, Report, collect, run_in_guest

_TESTS = (
    "tests/contract/devices/v4l2_vivid_guest.py",
    "tests/contract/devices/v4l2_usb_guest.py",
    "tests/contract/test_camera_contract.py",
)
# A boot without KVM takes half a minute, the tests a minute and a half; a machine with other work takes its time
_LIMIT_S = 600.0


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "name" in metafunc.fixturenames:
        found = [
            pytest.param(name, id=name.removeprefix("tests/"), marks=[getattr(pytest.mark, m)(*a) for m, a in marks])
            for name, marks in collect(_TESTS)
            if not name.endswith("[NOTSET]")  # a test for other backends only
        ]
        metafunc.parametrize("name", found)


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Report:
    try:
        return run_in_guest(_TESTS, tmp_path_factory.mktemp("guest"), limit_s=_LIMIT_S)
    except Missing as error:
        missing(str(error))
        raise AssertionError from error


@pytest.mark.timeout(_LIMIT_S + 120)
def test_in_the_guest(name: str, report: Report, capsys: pytest.CaptureFixture[str]) -> None:
    found = report.outcomes.get(name, Outcome())
    print(f"{found.seconds:.2f} s in the guest\n{found.output}")
    if found.outcome == "lost":
        pytest.fail(f"the guest ended after {report.seconds:.0f} s without this test:\n{report.tail}", pytrace=False)
    if found.outcome == "skipped":
        pytest.skip(found.text)
    if found.outcome != "passed":
        pytest.fail(found.text, pytrace=False)
