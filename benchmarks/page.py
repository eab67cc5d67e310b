"""Time from a pointer move to the redraw with the followed optimum on the page of `leapnav play`.

    python benchmarks/page.py

The real server runs in its own process; headless Chromium draws without a GPU. The last column is the ratio to the
smallest window, on the same work in the same run.
"""

import re
import shutil
import statistics
import subprocess
import sys
from typing import Any

from playwright.sync_api import Page, sync_playwright

SIZES = ((390, 844), (1280, 800), (3840, 2160))
SCENARIOS = (("clutter", 7), ("rooms", 3), ("slalom", 3))
N_MOVES, INTERVAL = 60, 16  # pointer moves per drag, and ms between two


def wait(page: Page) -> None:
    """Wait until the full search has ended."""
    while not page.evaluate("play.searched && play.pending === 0"):
        page.wait_for_timeout(20)


def drag(page: Page, start: Any, end: Any) -> float:
    """Drag from one point of the plane (m) to another and back; return the median time to the redraw (ms)."""
    page.evaluate("window.scrollTo(0, 0)")
    box = page.locator("#view").bounding_box()
    assert box is not None
    (x0, y0), (x1, y1) = (page.evaluate("(point) => toScreen(point)", point) for point in (start, end))
    page.evaluate("play.latencies.length = 0")
    page.mouse.move(box["x"] + x0, box["y"] + y0)
    page.mouse.down()
    for k in range(1, N_MOVES + 1):
        s = 1 - abs(2 * k / N_MOVES - 1)
        page.mouse.move(box["x"] + x0 + s * (x1 - x0), box["y"] + y0 + s * (y1 - y0))
        page.wait_for_timeout(INTERVAL)
    page.mouse.up()
    wait(page)
    return statistics.median(page.evaluate("Array.from(play.latencies)"))


def main() -> None:
    """Measure and print."""
    command = [sys.executable, "-m", "leapnav", "play", "--no-browser", "--port", "0"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    found = re.search(r"http://\S+", server.stdout.readline())
    assert found is not None
    medians: dict[int, list[float]] = {width: [] for width, _ in SIZES}
    try:
        with sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
            for width, height in SIZES:
                page = browser.new_page(viewport={"width": width, "height": height})
                page.goto(found[0])
                wait(page)
                for family, index in SCENARIOS:
                    page.select_option("#family", family)
                    page.fill("#index", str(index))
                    page.click("#load")
                    page.wait_for_timeout(300)
                    wait(page)
                    goal = page.evaluate("play.scenario.goal")
                    median = drag(page, goal[:2], [goal[0] + 0.3, goal[1] - 0.3])
                    medians[width].append(median)
                    print(f"{width:5d} px, {family} {index}: {median:.1f} ms", flush=True)
                page.close()
            browser.close()
    finally:
        server.terminate()
        server.wait()
    first = statistics.median(medians[SIZES[0][0]])
    for width, values in medians.items():
        print(
            f"{width:5d} px: median {statistics.median(values):.1f} ms, ratio {statistics.median(values) / first:.2f}"
        )


if __name__ == "__main__":
    main()
