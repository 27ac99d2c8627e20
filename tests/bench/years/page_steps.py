"""The page on a test of thousands of steps: what Chromium's scripts and layout take, by processor time."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from tests.bench.page.browser import browser, fresh_page
from tests.bench.years.measure import API, running


def seconds_on_page(folder: Path, test_id: str, picture: Path | None = None) -> dict[str, float]:
    """Open a test's screen, go through its steps, and return what that took.

    Parameters
    ----------
    folder
        Holds ``data/``, the data folder.
    picture
        Gets a picture of the list of steps.
    """
    found: dict[str, float] = {}
    with running(folder) as (_, client, _wall), browser() as made, fresh_page(made) as page:
        session = page.context.new_cdp_session(page)
        session.send("Performance.enable")

        def spent(what: str) -> dict[str, float]:
            metrics = {one["name"]: one["value"] for one in session.send("Performance.getMetrics")["metrics"]}
            now = {
                name: metrics[name]
                for name in ("ScriptDuration", "LayoutDuration", "RecalcStyleDuration", "TaskDuration")
            }
            for name, value in now.items():
                found[f"{what}, {name}"] = round(value - sum(v for k, v in found.items() if k.endswith(name)), 4)
            found[f"{what}, nodes"] = metrics["Nodes"]
            return now

        page.goto(f"{client.base_url}#/test/{test_id}")
        thumbnails = page.locator('[data-role="thumbnails"]')
        thumbnails.locator("figure").first.wait_for()
        page.wait_for_timeout(2000)
        spent("opened")
        if page.get_by_role("button", name="Earlier steps").count():
            for _ in range(5):
                page.get_by_role("button", name="Earlier steps").click()
            page.wait_for_timeout(1000)
        else:
            thumbnails.evaluate("box => { box.scrollTop = box.scrollHeight / 2; }")
            page.wait_for_timeout(1000)
        spent("five pages back")
        client.patch(
            f"{API}/tests/{test_id}/steps/1", json={"label": "another"}, headers={"If-Match": "*"}
        ).raise_for_status()
        page.wait_for_timeout(1500)
        spent("a step changed")
        if picture is not None:
            thumbnails.scroll_into_view_if_needed()
            page.screenshot(path=picture)
    return found


def main() -> None:
    found = seconds_on_page(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]) if len(sys.argv) > 3 else None)
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
