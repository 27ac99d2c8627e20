"""Measures how fast the page is: first paint, live views and what they cost the service, a field of 100,000 points.

Run from the repository's root, on a machine that does nothing else::

    python -m tests.bench.page.speed [--print]     # writes the figures into docs/explanation/page_speed.md, or only prints them

The rig is config/sim_paper.toml, whose cameras are rendered by the service itself: the rendering is in its processor
time. The browser runs on the same machine and is not.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import tempfile
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import httpx
import psutil
from playwright.sync_api import Browser, Page

from stereorig.server.demo.process import running_service
from tests.bench.documents.prose import wrapped
from tests.bench.page.browser import browser, fresh_page
from tests.bench.speed.scaling import RIG, ROOT, TEST, write_test

PAGE = ROOT / "docs" / "explanation" / "page_speed.md"
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"
API = "/api/v1"
PAINTS = 7
LIVE_S = 10.0
# 351 x 351 points
BODY = {
    "region": {"rectangle": [80, 64, 430, 414]},
    "subset_px": 21,
    "spacing_px": 1,
    "patch": "affine",
    "strain": None,
    "label": "fine",
}

# each exposure has its own noise, so a changed picture is another frame
_COUNT = """
async seconds => {
  const views = [...document.querySelectorAll(".view")].map((view) => view.querySelector("img"));
  const pens = views.map(() => new OffscreenCanvas(24, 24).getContext("2d", { willReadFrequently: true }));
  const last = views.map(() => ""), frames = views.map(() => -1);
  const until = performance.now() + 1000 * seconds;
  while (performance.now() < until) {
    views.forEach((image, k) => {
      if (!image.naturalWidth) return;
      pens[k].drawImage(image, 200, 200, 24, 24, 0, 0, 24, 24);
      const now = pens[k].getImageData(0, 0, 24, 24).data.join();
      if (now !== last[k]) { last[k] = now; frames[k] += 1; }
    });
    await new Promise((resolve) => setTimeout(resolve, 15));
  }
  return frames;
}
"""

# from the click until the frame after the map's drawing is on the screen
_PAINTED = """
async ([act, shown]) => {
  const began = performance.now();
  if (act.click) document.querySelector(act.click).click();
  else {
    const choice = document.querySelector(act.choose);
    choice.value = act.value;
    choice.dispatchEvent(new Event("change", { bubbles: true }));
  }
  const frame = () => new Promise(requestAnimationFrame);
  for (;;) {
    if (performance.now() - began > 60000) throw new Error(`${shown} was not drawn in 60 s`);
    await frame();
    const map = document.querySelector(`canvas[data-role=map][data-shown="${shown}"]`);
    if (map?.width > 300) break;
  }
  await frame();
  return performance.now() - began;
}
"""


@dataclass
class Figure:
    """One row of the table: what, the value, its unit, and what it may be."""

    what: str
    value: float
    unit: str
    max_value: float | None = None
    min_value: float | None = None

    @property
    def met(self) -> str:
        """Whether it is what was asked."""
        if self.max_value is None and self.min_value is None:
            return ""
        good = self.value <= self.max_value if self.max_value is not None else self.value >= (self.min_value or 0.0)
        return "yes" if good else "**no**"

    @property
    def asked(self) -> str:
        """What was asked, in words."""
        if self.max_value is not None:
            return f"at most {self.max_value:g}"
        return "" if self.min_value is None else f"at least {self.min_value:g}"


def first_paint(made: Browser, url: str) -> list[Figure]:
    """Time of the first content on the screen, with nothing in the cache, on each screen."""
    figures = []
    for screen in ("rig", "results"):
        times = []
        for _ in range(PAINTS):
            with fresh_page(made) as page:
                page.goto(f"{url}/#/{screen}")
                page.wait_for_selector("h1")
                found = "performance.getEntriesByName('first-contentful-paint')[0]?.startTime"
                page.wait_for_function(f"() => {found}")
                times.append(float(page.evaluate(found)) / 1e3)
        figures.append(
            Figure(f"first paint, {screen}, median of {PAINTS}", statistics.median(times), "s", max_value=1.0)
        )
        figures.append(Figure(f"first paint, {screen}, slowest", max(times), "s"))
    return figures


def service_processes() -> list[psutil.Process]:
    """Return the service that this process started, and its workers."""
    return [p for p in psutil.Process().children(recursive=True) if _is_service(p)]


def _is_service(process: psutil.Process) -> bool:
    try:
        line = [*process.cmdline(), *(part for parent in process.parents() for part in parent.cmdline())]
    except psutil.Error:
        return False
    return "stereorig.server.cli" in line


def processor_s() -> float:
    """Processor time of the service so far."""
    return sum(sum(p.cpu_times()[:2]) for p in service_processes())


def live_views(made: Browser, url: str) -> list[Figure]:
    """Frames a second that the page decodes of each camera, and the service's share of a core meanwhile."""
    with fresh_page(made) as page:
        page.goto(f"{url}/#/rig")
        page.wait_for_function(
            "() => { const i = [...document.querySelectorAll('.view')].map((v) => v.querySelector('img'));"
            " return i.length === 2 && i.every((one) => one.naturalWidth) }"
        )
        page.wait_for_timeout(3000)  # charts have come, kernels are compiled
        before, began = processor_s(), time.monotonic()
        frames = page.evaluate(_COUNT, LIVE_S)
        seconds, used = time.monotonic() - began, processor_s() - before
    return [
        *(Figure(f"live view, camera {k + 1}", n / LIVE_S, "frames/s", min_value=9.5) for k, n in enumerate(frames)),
        Figure("service's processor time meanwhile", 100.0 * used / seconds, "% of a core", max_value=60.0),
    ]


def large_field(made: Browser, url: str) -> list[Figure]:
    """Measure more than 100,000 points, then open them in the page."""
    with httpx.Client(base_url=f"{url}{API}", timeout=60.0, trust_env=False) as client:
        accepted = client.post(f"/tests/{TEST}/analyses", json=BODY).raise_for_status().json()
        while (job := client.get(f"/jobs/{accepted['job']['id']}").json())["state"] in ("queued", "running"):
            time.sleep(0.2)
        if job["state"] != "succeeded":
            raise SystemExit(f"the analysis {job['state']}: {job['problem']}")
        path = f"/tests/{TEST}/analyses/{accepted['analysis_id']}"
        points = client.get(path).json()["summary"]["steps"][-1]["points"]
    names = {
        "opened from the list of results": (
            {"click": f'a[href="#/results/{TEST}/{accepted["analysis_id"]}"]'},
            "2 w_mm",
        ),
        "another field of the step": ({"choose": "#resultfield", "value": "u_mm"}, "2 u_mm"),
        "another step": ({"click": '[aria-label="Step before"]'}, "1 u_mm"),
    }
    times: dict[str, list[float]] = {name: [] for name in names}
    for _ in range(3):
        with fresh_page(made) as page:
            page.goto(f"{url}/#/results/{TEST}")
            page.wait_for_selector(f'a[href*="{accepted["analysis_id"]}"]')
            page.wait_for_timeout(500)
            for name, (act, shown) in names.items():
                times[name].append(painted(page, act, f"{shown} reference"))
                page.wait_for_timeout(1500)
            painted(page, {"choose": "#resultfield", "value": "w_mm"}, "1 w_mm reference")  # the field is kept
            page.wait_for_timeout(1500)
    return [
        Figure(f"field of {points:,} points, {name}, median of 3", statistics.median(found), "s", max_value=2.0)
        for name, found in times.items()
    ]


def painted(page: Page, act: dict[str, str], shown: str) -> float:
    """Seconds from a click until what was asked for is on the screen."""
    return float(page.evaluate(_PAINTED, [act, shown])) / 1e3


def measure() -> list[Figure]:
    """Measure every row."""
    with tempfile.TemporaryDirectory() as folder, browser() as made:
        data = Path(folder) / "data"
        write_test(data / "tests" / TEST, steps=3)
        with running_service(RIG, data, Path(folder) / "service.log") as url:
            wait_for_rig(url)
            return [*first_paint(made, url), *live_views(made, url), *large_field(made, url)]


def wait_for_rig(url: str) -> None:
    """Wait until the simulated stage is homed and the kernels that cameras need are compiled."""
    with httpx.Client(base_url=f"{url}{API}", timeout=120.0, trust_env=False) as client:
        while not (rig := client.get("/rig").json())["connected"] or rig["holder"]:
            time.sleep(0.2)
        client.get("/cameras/cam1/frame").raise_for_status()


def table(figures: list[Figure], load: tuple[float, float]) -> str:
    """Return the measured part of the page."""
    cores = len(os.sched_getaffinity(0))
    return "\n".join(
        [
            f"Measured on {datetime.now(UTC):%Y-%m-%d} by `make pagespeed`: {cores} cores, Linux {platform.machine()}, Python "
            f"{platform.python_version()}; service and browser on the same machine. Its load average was {load[0]:.1f} before and "
            f"{load[1]:.1f} after.",
            "",
            "| what | measured | unit | asked | met |",
            "| --- | --- | --- | --- | --- |",
            *(f"| {f.what} | {f.value:.3g} | {f.unit} | {f.asked} | {f.met} |" for f in figures),
        ]
    )


def main() -> None:
    """Measure, and put the table into the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--print", action="store_true", dest="only_print", help="leave docs/explanation/page_speed.md as it is"
    )
    only_print = parser.parse_args().only_print
    load = os.getloadavg()[0]
    text = table(measure(), (load, os.getloadavg()[0]))
    print(text)
    if only_print:
        return
    page = PAGE.read_text(encoding="utf-8")
    head, _, rest = page.partition(BEGIN)
    PAGE.write_text(f"{head}{BEGIN}\n{wrapped(text)}\n{END}{rest.partition(END)[2]}", encoding="utf-8")


if __name__ == "__main__":
    main()
