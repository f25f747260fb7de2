"""The report in a real browser: drawn, playing, silent, and as narrow as a phone."""

from __future__ import annotations

import pytest
from browser import chromium, page_of
from report_synthetic import make_result

from wbm.report.page import write_page

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    return write_page(folder / "report.html", make_result(folder, films=2)).as_uri()


def test_report_in_a_browser(address, tmp_path):
    with chromium() as browser:
        for width, scheme in ((1200, "light"), (390, "dark")):
            with page_of(browser, width, scheme=scheme) as (page, troubles):
                page.goto(address)
                page.wait_for_load_state("load")
                facts = page.evaluate(
                    """() => ({
                    overflow: document.documentElement.scrollWidth - window.innerWidth,
                    plots: [...document.querySelectorAll('svg')].map(s => [s.getBoundingClientRect().width,
                        s.getBoundingClientRect().height, s.querySelectorAll('path, use').length]),
                    images: [...document.images].map(i => [i.complete, i.naturalWidth]),
                    ids: [...document.querySelectorAll('[id]')].map(e => e.id),
                    anchors: [...document.querySelectorAll('nav a')].map(
                        a => !!document.querySelector(a.getAttribute('href'))),
                    ink: getComputedStyle(document.querySelector('h1')).color,
                    paper: getComputedStyle(document.body).backgroundColor,
                    label: getComputedStyle(document.querySelector('svg text')).fill,
                    })"""
                )
                assert facts["overflow"] <= 0
                assert len(facts["plots"]) == 5
                assert all(w > 200 and h > 80 and n > 5 for w, h, n in facts["plots"])
                assert len(facts["images"]) == 10 and all(done and w > 0 for done, w in facts["images"])
                assert len(facts["ids"]) == len(set(facts["ids"]))
                assert len(facts["anchors"]) == 8 and all(facts["anchors"])
                dark = sum(int(v) for v in facts["paper"][4:-1].split(",")) < 150
                assert dark == (scheme == "dark")
                # Plots take part in the theme: their text is never as dark as the page.
                brightness = sum(int(v) for v in facts["label"][4:-1].split(","))
                assert (brightness > 380) == dark
                played = page.evaluate(
                    """async () => { const results = [];
                    for (const v of document.querySelectorAll('video')) { v.muted = true; await v.play();
                        await new Promise(r => {
                            const t = setInterval(() => { if (v.currentTime > 0.1) { clearInterval(t); r(); } }, 20);
                                                 setTimeout(r, 5000); });
                        results.push([v.currentTime, v.videoWidth, v.error]); v.pause(); }
                    return results; }"""
                )
                assert len(played) == 4
                assert all(time > 0.1 and w == 160 and error is None for time, w, error in played)
                assert not troubles
