"""The documentation as a web site: opened from the disk, in a real browser."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from conftest import ROOT

pytestmark = [pytest.mark.docs, pytest.mark.browser]
PHONE = {"width": 390, "height": 844}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("material", reason="the extra `docs`")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet"]
    quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    subprocess.run([*command, "--site-dir", folder], cwd=ROOT, env=quiet, check=True)
    return folder


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api")
    found = shutil.which("chromium")
    if found is None:
        pytest.skip("chromium is not installed")
    with playwright.sync_playwright() as p:
        opened = p.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield opened
        opened.close()


def test_search_works_from_the_disk_and_fetches_nothing(site: Path, browser: Any):
    tab, fetched = browser.new_page(), []
    tab.on("request", lambda r: fetched.append(r.url))
    tab.goto((site / "index.html").as_uri())
    tab.get_by_placeholder("Search").first.click()
    tab.keyboard.type("friction pyramid")
    tab.wait_for_selector(".md-search-result__item", timeout=60_000)
    assert "Derivations" in tab.locator(".md-search-result__list").inner_text()
    assert [u for u in fetched if not u.startswith(("file:", "data:", "blob:"))] == []
    tab.close()


def test_no_page_is_wider_than_a_phone(site: Path, browser: Any):
    tab = browser.new_page(viewport=PHONE)
    for page in sorted(site.glob("*.html")):
        tab.goto(page.as_uri(), wait_until="domcontentloaded")
        width = tab.evaluate("document.documentElement.scrollWidth")
        assert width <= PHONE["width"], page.name
    tab.close()
