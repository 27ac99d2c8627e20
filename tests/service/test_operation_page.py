"""docs/how_to/operate.md against the program: its metrics, limits, codes and commands are those that there are."""

from __future__ import annotations

import re
import tomllib

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from stereorig.server.api.docs.pages import known_problems
from stereorig.server.cli.main import main
from stereorig.server.config.rig_file import ServiceSection
from tests.support.api_description import current
from tests.support.requirements import ROOT
from tests.support.service_rig import wait_for_rig

pytestmark = pytest.mark.warm_worker

PAGE = ROOT / "docs" / "how_to" / "operate.md"
TEXT = PAGE.read_text(encoding="utf-8")


def table(heading: str) -> list[list[str]]:
    """Rows of the first table after a heading, without its head."""
    _, _, after = TEXT.partition(f"# {heading}\n")
    assert after, heading
    rows = []
    for line in after.splitlines():
        if line.startswith("|"):
            rows.append([cell.strip() for cell in line.strip("|").split("|")])
        elif rows:
            break
    return rows[2:]


def names(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def test_the_table_of_metrics_is_what_the_service_tells(client: httpx.Client) -> None:
    wait_for_rig(client)
    expected = {
        family.name: family.type
        for family in text_string_to_metric_families(client.get("/metrics").text)
        if not family.name.startswith("process_")
    }
    listed = {names(row[0])[0]: row[1] for row in table("Metrics")}
    assert listed == expected
    assert len(listed) > 30


def test_the_alarms_name_metrics_that_there_are(client: httpx.Client) -> None:
    wait_for_rig(client)
    samples = {line.split()[2] for line in client.get("/metrics").text.splitlines() if line.startswith("# TYPE")}
    alarms = set(re.findall(r"stereorig_[a-z_]+", TEXT.partition("Worth an alarm")[2].partition("## Logs")[0]))
    assert len(alarms) >= 4
    assert alarms <= samples


def test_the_limits_are_the_rig_files_with_their_usual_values() -> None:
    listed = {names(row[0])[0]: row[1] for row in table("Limits")}
    assert set(listed) == set(ServiceSection.model_fields)
    for name, field in ServiceSection.model_fields.items():
        if isinstance(field.default, int | float) and not isinstance(field.default, bool):
            assert float(listed[name]) == field.default, name


def test_every_code_of_the_table_is_one_that_the_service_gives() -> None:
    known = set(known_problems())
    listed = [code for row in table("When something fails") for code in names(row[0])]
    assert len(listed) == len(set(listed)) > 25
    assert set(listed) <= known


def test_the_paths_it_names_are_operations() -> None:
    plain = {re.sub(r"\{[a-z_]+\}", "{}", path.removeprefix("/api/v1")) for path in current()["paths"]}
    for method, path in re.findall(r"`(GET|POST|PUT|PATCH|DELETE) ([^`]+)`", TEXT):
        named = re.sub(r"\{[a-z_]+\}", "{}", path).removeprefix("...")
        end = "{}:" + named.rpartition(":")[2] if path.startswith("...") else named
        found = [other for other in plain if other == named or (path.startswith("...") and other.endswith(end))]
        assert found, (method, path)


def test_the_commands_it_names_are_commands() -> None:
    called = set(re.findall(r"stereorig (keys|rigfile|doctor|verify|repair|serve|trash|measure)\b", TEXT))
    assert called == {"keys", "rigfile", "doctor", "verify", "repair", "serve", "trash", "measure"}
    for command in called:
        with pytest.raises(SystemExit) as ended:
            main([command, "--help"])
        assert ended.value.code == 0, command


def test_what_it_says_to_run_in_a_container_is_what_the_file_says() -> None:
    container = (ROOT / "deploy" / "Containerfile").read_text(encoding="utf-8")
    build = "podman build --format docker -f deploy/Containerfile -t stereorig ."
    assert build in TEXT
    assert build in container
    assert re.search(r"--uid (\d+)", container)[1] in TEXT  # type: ignore[index]


def test_the_readme_leads_to_it() -> None:
    assert "(docs/how_to/operate.md)" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_container_is_built_of_every_package_and_of_the_simulated_rigs() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    wanted = {pattern.rstrip("*") for pattern in project["tool"]["setuptools"]["packages"]["find"]["include"]}
    wanted |= {"config"}  # the wheel holds the simulated rigs
    container = (ROOT / "deploy" / "Containerfile").read_text(encoding="utf-8")
    assert wanted <= set(re.findall(r"^COPY (\w+) \1$", container, re.MULTILINE))
    assert wanted <= set(re.findall(r"^!(\w+)$", (ROOT / ".containerignore").read_text(encoding="utf-8"), re.MULTILINE))
