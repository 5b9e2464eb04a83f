"""What the README shows runs, and is true."""

import re

import pytest
from pages import ROOT, blocks, page

README = (ROOT / "README.md").read_text()
PAGE = page("README.md")


@pytest.fixture(autouse=True)
def opened(monkeypatch):
    """Pages that a browser is asked for."""
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    return opened


@pytest.mark.users_settings
def test_its_first_block_makes_what_it_says(opened):
    PAGE.run(1)
    assert opened[0].startswith("file:")
    assert "showMechanism" in (PAGE.folder / "four_bar.html").read_text()
    assert (PAGE.folder / "coupler.png").stat().st_size > 1e4
    assert PAGE.names["solution"].worst_violation().position < 1e-13


@pytest.mark.users_settings
@pytest.mark.parametrize("count", range(2, len(blocks(PAGE.path)) + 1))
def test_the_other_blocks_run(count):
    PAGE.run(count)


def test_someone_reads_it_to_the_end():
    assert len(README.splitlines()) <= 150


def test_its_links_lead_somewhere():
    for link in re.findall(r"\]\((?!https?:|#)([^)]+)\)", README):
        assert (ROOT / link.split("#")[0]).exists(), link
