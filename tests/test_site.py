"""The documentation: every page is in the menu, every link and picture is there, the site builds."""

import os
import pathlib
import re
import runpy
import subprocess
import sys

import api
import browser
import pytest

_MENU = runpy.run_path(str(pathlib.Path(__file__).parents[1] / "docs" / "conf.py"))["menu"]
_FENCE = re.compile(r"^(`{3,}|:{3,}).*?^\1\s*$", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


def pages(repo):
    return sorted(p for p in (repo / "docs").rglob("*.md") if "_build" not in p.parts)


def in_menu(page):
    """Pages in the menu that a page makes."""
    if page.name == "index.md":
        for names in _MENU(page.read_text()).values():
            yield from ((page.parent / f"{name}.md").resolve() for name in names)


def links(text):
    """Targets of links and pictures, code left out."""
    return _LINK.findall(re.sub(r"`[^`\n]*`", "", _FENCE.sub("", text)))


def anchors(text):
    """What GitHub and MyST call the headings."""
    heads = re.findall(r"^#+ (.*)$", _FENCE.sub("", text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).strip().replace(" ", "-") for head in heads}


def broken(page):
    """Targets of a page that lead nowhere."""
    out = []
    for target in links(page.read_text()):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        there = (page.parent / name).resolve() if name else page
        if not there.exists() or (anchor and anchor not in anchors(there.read_text())):
            out.append(target)
    return out


def test_broken_links_are_found(tmp_path):
    (tmp_path / "b.md").write_text("# A title, it is\n")
    (tmp_path / "a.md").write_text(
        "[x](b.md#a-title-it-is) [y](c.md) ![z](z.png) [w](b.md#no)\n```\n[q](q.md)\n```\n`[r](r.md)`"
    )
    assert broken(tmp_path / "a.md") == ["c.md", "z.png", "b.md#no"]


def test_every_page_is_in_the_menu(repo):
    found, more = set(), {(repo / "docs" / "index.md").resolve()}
    while more:
        page = more.pop()
        assert page.is_file(), f"a menu names {page.relative_to(repo)}, which is not there"
        found.add(page)
        more |= set(in_menu(page)) - found
    lost = {p.resolve() for p in pages(repo)} - found
    assert not lost, f"in no menu: {', '.join(str(p.relative_to(repo)) for p in sorted(lost))}"


def test_no_link_is_broken(repo):
    wrong = {
        str(p.relative_to(repo)): broken(p)
        for p in [repo / "README.md", repo / "CONTRIBUTING.md", *pages(repo)]
    }
    assert not any(wrong.values()), "\n".join(f"{p}: {', '.join(t)}" for p, t in wrong.items() if t)


def test_code_names_pages_that_are_there(repo):
    """Docstrings, messages and comments that send a reader to docs/."""
    lost = []
    for folder in ("biotac_mj", "benchmarks", "examples", "scripts", "tests"):
        for path in (repo / folder).rglob("*.py"):
            for name in re.findall(r"\bdocs/[\w/]+\.md\b", path.read_text()):
                if not (repo / name).is_file():
                    lost.append(f"{path.relative_to(repo)}: {name}")
    assert not lost, "\n".join(lost)


@pytest.mark.slow
def test_the_api_page_has_todays_docstrings(repo):
    assert (repo / "docs" / "api.md").read_text() == api.api(), "run python scripts/api.py"


def test_pages_read_as_plain_markdown(repo):
    """No directive: what shows code or a picture on the site shows it on a Git host too."""
    for page in pages(repo):
        assert not re.findall(r"^(?:```|:::)\{(\w[\w-]*)\}", page.read_text(), re.M), page
    assert len((repo / "docs" / "validation.md").read_text().split()) <= 1500


@pytest.mark.slow
def test_the_site_builds(repo, tmp_path):
    """Pages are as they are; `tests/test_documents.py` runs them."""
    for name in ("sphinx", "myst_parser", "furo", "sphinx_copybutton"):
        pytest.importorskip(name, reason="the site needs the extra docs: make docs")
    command = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--keep-going", "--quiet"]
    done = subprocess.run(
        [*command, "-d", tmp_path / "trees", repo / "docs", tmp_path / "site"],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    assert "biotac_mj.attach" in (tmp_path / "site" / "api.html").read_text()
    if browser.executable() is None:
        return
    wide, start = "document.documentElement.scrollWidth", (tmp_path / "site" / "start.html").as_uri()
    for width in (1100, 1280):
        profile = tmp_path / str(width)
        profile.mkdir()
        with browser.Browser(start, profile, (width, 700)) as window:
            window.until(lambda _, w=window: w.evaluate("document.readyState == 'complete'"))
            assert window.evaluate(wide) <= width, f"lines are cut in a window of {width} pixels"
