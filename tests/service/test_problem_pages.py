"""The list of problems, and the pages that need nothing from elsewhere."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path

import httpx
import pytest

from stereorig.server.api.docs.pages import known_problems
from tests.bench.documents.problem_list import LIST, PACKAGES, ROOT, scan, text_of, tree

STATIC = ROOT / "server" / "static"
COMMAND = "run `make problems` and commit what it writes"
# keywords named code that are no code of a problem
OTHER = {"ok"}


def test_the_list_is_that_of_the_source() -> None:
    if LIST.read_text(encoding="utf-8") == text_of(scan()):
        return
    before, now = json.loads(LIST.read_text(encoding="utf-8")), scan()
    differ = [code for code in sorted(before | now) if before.get(code) != now.get(code)]
    pytest.fail(f"server/static/problems.json is not what the source says: {COMMAND}. Codes that differ: {differ}")


def test_every_code_that_the_source_spells_is_in_it() -> None:
    spelled: dict[str, Path] = {}
    for path in (p for package in PACKAGES for p in (ROOT / package).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        for code in re.findall(r'\bcode="([a-z0-9_]+)"', text):
            spelled[code] = path
        for code in re.findall(r'problem_response\(\s*\d+,\s*"([a-z0-9_]+)"', text):
            spelled[code] = path
    assert len(spelled) > 150
    missing = {code: path for code, path in spelled.items() if code not in known_problems() and code not in OTHER}
    assert not missing, COMMAND
    for cls in tree().values():
        assert cls.code in known_problems() or cls.name == "StereorigError", cls.name


def test_each_has_status_cause_and_remedy() -> None:
    for code, problem in known_problems().items():
        assert re.fullmatch(r"[a-z][a-z0-9_]+", code)
        assert problem["status"], code
        assert all(400 <= status < 600 for status in problem["status"]), code
        assert problem["causes"], code
        assert problem["remedies"], code
    assert known_problems()["hardware_busy"]["status"] == [409]
    assert known_problems()["storage_full"]["status"] == [507]
    assert known_problems()["key_missing"]["status"] == [401]


def test_a_new_class_of_the_tree_has_a_status() -> None:
    for cls in tree().values():
        if cls.name != "StereorigError":
            assert cls.status("some_new_code") != 500, cls.name


def test_one_page_lists_them_all_and_each_type_leads_to_it(client: httpx.Client) -> None:
    text = client.get("/problems").text
    for code, problem in known_problems().items():
        assert f"id='{code}'" in text
        for sentence in problem["causes"] + problem["remedies"]:
            assert html.escape(sentence) in text
    refused = client.get("/api/v1/jobs/j999999-abcdef").json()
    found = client.get(refused["type"])
    assert found.status_code == 200
    assert "There is no job" in found.text
    reply = client.get(refused["type"], headers={"Accept": "application/json"}).json()
    assert reply["code"] == "not_found"
    assert reply["status"] == [404]
    assert client.get("/problems.json").json() == known_problems()
    unknown = client.get("/problems/nothing_like_it")
    assert unknown.status_code == 404
    assert unknown.json()["code"] == "not_found"


@pytest.mark.parametrize("path", ["/docs", "/docs/operations", "/problems"])
def test_pages_ask_nothing_of_other_hosts(client: httpx.Client, path: str) -> None:
    answer = client.get(path)
    assert answer.status_code == 200
    assert "script-src" not in answer.headers["content-security-policy"]
    assert answer.headers["content-security-policy"].startswith("default-src 'self'")
    assert not re.search(r"<script>|\son[a-z]+=|javascript:", answer.text), "the policy lets no inline script run"
    wanted = re.findall(r"""(?:src|href)=['"]([^'"]*)""", answer.text)
    assert wanted
    for link in wanted:
        assert link.startswith("/"), link
        if link.startswith("/static/"):
            assert client.get(link).status_code == 200, link


def test_interactive_docs_are_vendored_with_their_licence(client: httpx.Client) -> None:
    page = client.get("/docs").text
    assert "/static/vendor/swagger-ui/swagger-ui-bundle.js" in page
    script = client.get("/static/vendor/swagger-ui/swagger-ui-bundle.js")
    assert script.headers["content-type"].startswith("text/javascript")
    assert len(script.content) > 10**6
    assert "Apache License" in (STATIC / "vendor" / "swagger-ui" / "LICENSE").read_text()
    start = client.get("/static/docs.js").text
    assert "validatorUrl: null" in start
    assert "http" not in start.replace("https", "http").replace('"/api', "")


@pytest.mark.fault(46)
@pytest.mark.parametrize(
    "path",
    [
        "/static/../api/app.py",
        "/static/%2e%2e/api/app.py",
        "/static//etc/passwd",
        "/static/..%2f..%2fpyproject.toml",
        "/static/vendor/swagger-ui/%00",
        "/static/%252e%252e/api/app.py",
        "/problems/..%2f..%2fpyproject.toml",
    ],
)
def test_no_path_leads_out_of_the_static_files(client: httpx.Client, path: str) -> None:
    # httpx would tidy the path
    url = httpx.URL(str(client.base_url)).copy_with(raw_path=path.encode())
    answer = client.get(url)
    assert answer.status_code == 404, answer.text[:100]
    assert answer.json()["code"] == "not_found"
