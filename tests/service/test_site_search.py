"""The site's own search, run in Node over the built site: words of other programs find the page that answers."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.requirements import ROOT
from tests.support.site_queries import LAST, QUERIES

_SHOWN = 3  # results that a reader looks at


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Pages found for each query, best first."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("Node is not installed")
    site = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "sphinx", "-q", "-b", "html", "docs", str(site)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    search = [node, str(Path(ROOT) / "tests" / "support" / "site_search.js"), str(site)]
    done = subprocess.run(search, input=json.dumps(list(QUERIES)), capture_output=True, text=True, check=True)
    return dict(zip(QUERIES, json.loads(done.stdout), strict=True))


def test_there_are_as_many_queries_as_were_tried_first() -> None:
    assert len(QUERIES) == 52


@pytest.mark.parametrize("query", QUERIES)
def test_a_query_finds_the_page_that_answers(found: dict[str, list[str]], query: str) -> None:
    shown = found[query][:_SHOWN]
    assert set(shown) & set(QUERIES[query]), found[query][:8]
    before = found[query][: min(found[query].index(page) for page in QUERIES[query] if page in shown)]
    assert not any(page.startswith(LAST) for page in before), shown
