"""The sample of an empty service: taken by a click, measured, and compared with the formula it was rendered from."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

import httpx
import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import expect

from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.bench.documents import sample
from tests.support.page_bench import Watched
from tests.support.service_rig import SMALL

pytestmark = pytest.mark.timeout(500)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    made = Service(parse_config(SMALL), tmp_path_factory.mktemp("sample") / "data").start()
    yield made
    made.close()


def test_the_sample_is_what_its_script_makes() -> None:
    files = sorted(sample.FOLDER.iterdir())
    assert sum(file.stat().st_size for file in files) < 3_000_000
    stored = np.asarray(Image.open(sample.FOLDER / "cam2_0003.png")).astype(int)
    differs = np.abs(stored - sample.pair_at(3)[1])
    # processors round the formulas' last bits otherwise
    assert differs.max() <= 1
    assert (differs > 0).mean() < 1e-3
    assert json.loads((sample.FOLDER / "sample.json").read_text()) == json.loads(json.dumps(sample.described()))


def test_an_empty_service_offers_a_sample_and_measures_it(page: Watched, client: httpx.Client) -> None:
    shown = page.open("#/test")
    shown.get_by_role("button", name="Try it").click()
    shown.wait_for_url(re.compile("#/results/"), timeout=200_000)
    expect(shown.get_by_label("Field", exact=True).first).to_contain_text("eyy")
    expect(shown.get_by_role("table").first).to_contain_text("across")
    test_id, analysis_id = re.findall(r"[ta]\d{6}-\w+", shown.url)[:2]

    def field(name: str) -> np.ndarray:
        path = f"/api/v1/tests/{test_id}/analyses/{analysis_id}/steps/3/fields/{name}"
        reply = client.get(path, params={"frame": "system"}).raise_for_status().json()
        return np.array(reply["values"], dtype=float)

    eyy, sigma = field("eyy"), field("sigma_eyy")
    # the unloaded sheet lies in the system frame's plane, its notch about the origin
    gradient = sample.SHEET.surface(100.0).tangents(np.stack([field("x_mm"), field("y_mm")], axis=-1))[..., 1]
    true = 0.5 * ((gradient**2).sum(axis=-1) - 1.0)
    valid = np.isfinite(eyy)
    assert valid.mean() > 0.85  # the notch is a tenth of the region
    off = (eyy - true)[valid] / sigma[valid]
    assert 0.9 < np.sqrt(np.mean(off**2)) < 1.2
    # beside the notch's ends three times what is far from it
    assert np.quantile(eyy[valid], 0.999) == pytest.approx(np.quantile(true[valid], 0.999), rel=0.1)
    assert np.nanmax(eyy) > 2.5 * np.nanmedian(eyy)
    shown = page.open("#/test")
    expect(shown.get_by_role("link", name="Sample: notched sheet in tension")).to_be_visible()
    expect(shown.get_by_role("button", name="Try it")).to_have_count(0)
