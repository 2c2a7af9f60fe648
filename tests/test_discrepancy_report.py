"""Findings, verdicts, their text and page. Whole diagnoses are checked against the schema where they are made
(`check_verdict` in test_discrepancy_recordings, _workflow and _simulated)."""

import dataclasses
import html.parser
import json
import math
import pathlib

import jsonschema
import numpy as np
import pytest
from verdicts import check_verdict, schema

from biotac_mj.discrepancy.report import plots
from biotac_mj.discrepancy.report.files import page, write_report
from biotac_mj.discrepancy.report.text import summary
from biotac_mj.discrepancy.report.verdict import SCHEMA, VERSION, Estimate, Finding, Gap, Verdict
from biotac_mj.effects.effect import Param

HOSTILE = '<script>alert("1")</script>&amp;'
WARM = Finding(
    id="warmup",
    name="warm-up",
    stage="T",
    physics="the liquid warms",
    confusable={"thermal": "record TDC"},
    channels=tuple(range(19)),
    parameters={"tau": Estimate.of(Param("s", 1, 100, "minutes", 60.0), 100.0, 90.0, 99.0)},
    evidence=12.0,
    p=0.001,
    confidence=0.9,
    confirmed=True,
    ties={"thermal": "temperature"},
    gap=Gap("counts", 10.0, 2.0, 1.0, "level of all electrodes"),
    start=0.0,
    end=60.0,
)
VERDICT = Verdict(
    kind="plain recording",
    name="a.txt",
    data="100 rows",
    significant=True,
    effects=[WARM],
    gap={
        "electrodes": Gap("counts", 10.0, 4.0, 2.0, "the electrodes"),
        "force": Gap("N", 0.3, 0.3, 1e-6, "the force"),
    },
    aside="the last rows",
    where=[{"channel": "e3", "condition": "hold", "p": 0.01}],
    where_note="cells",
    tried=[{"id": "warmup", "name": "warm-up", "evidence_nats": 12.0}],
    tried_note="causes",
    notes=["no TDC: whether it is warmth"],
    next_experiment="record TDC",
    next_command="biotac next out/report --out plan.csv",
)


def everywhere(text):
    """The verdict with a text wherever a file, a user's effect or a user's sensor may put one."""
    finding = dataclasses.replace(
        WARM,
        name=text,
        physics=text,
        note=text,
        parameters={text: Estimate(1.0, unit=text)},
        ties={"x": text},
        confusable={"x": text},
        gap=Gap(text, 2.0, 1.0, 0.1, text),
    )
    lines = ("name", "data", "aside", "where_note", "remainder", "tried_note", "next_experiment")
    return dataclasses.replace(
        VERDICT,
        **dict.fromkeys(lines, text),
        effects=[finding],
        not_named=[finding],
        gap={text: Gap(text, 2.0, 1.0, 0.1, text)},
        where=[{"channel": text, text: text}],
        tried=[{"id": text, "name": text, text: text}],
        **{name: [text] for name in ("warnings", "notes", "amended")},
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Drawn(Verdict):
    figure: object

    def pictures(self):
        return {"channels": self.figure}


class Tags(html.parser.HTMLParser):
    """Tags that are opened, by name, and those that are open at the end."""

    def __init__(self, text):
        super().__init__()
        self.opened, self.open, self.data = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.opened.append(tag)
        if tag not in ("meta", "br", "img", "!doctype"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, f"</{tag}> closes nothing"

    def handle_data(self, data):
        self.data.append(data)


def test_names_in_the_page_are_escaped():
    tags = Tags(page(everywhere(HOSTILE)))
    assert "script" not in tags.opened
    assert "".join(tags.data).count(HOSTILE) > 30, "what was escaped is read as it was"


def test_every_tag_of_the_page_is_closed():
    empty = dataclasses.replace(VERDICT, effects=[], where=[], tried=[], notes=[], next_experiment="")
    for verdict in (VERDICT, empty):
        assert not Tags(page(verdict)).open


def test_the_schema_takes_what_is_written(tmp_path):
    figure = plots.channels([Gap("counts", 2.0, 1.0, 0.5, "a", ("e1",), (2.0,), (1.0,))])
    drawn = Drawn(**vars(everywhere(HOSTILE)), figure=figure)
    paths = write_report(drawn, tmp_path)
    assert [p.name for p in paths] == ["report.html", "verdict.json", "channels.png"]
    assert "data:image/png;base64" in paths[0].read_text() and 'src="channels' not in paths[0].read_text()
    written = json.loads(paths[1].read_text())
    check_verdict(written)
    (effect,) = written["effects"]
    assert effect["ties"] == ["x"] and effect["channels"] == [f"e{k + 1}" for k in range(19)]
    nothing = dataclasses.replace(WARM, gap=None, confidence=None, confirmed=None, start=None, end=None)
    check_verdict(dataclasses.replace(VERDICT, effects=[nothing]).to_dict())


@pytest.mark.parametrize(
    "change",
    [
        {"version": VERSION + 1},
        {"effects": [{"id": "warmup"}]},
        {"gap": {}},
        {"where": [{"p": 0.1}]},
        {"remainder": "unknown"},
    ],
)
def test_the_schema_refuses_what_is_not_a_verdict(change):
    with pytest.raises(jsonschema.ValidationError):
        check_verdict(VERDICT.to_dict() | change)


def test_the_how_to_has_every_key_of_the_schema():
    page = (pathlib.Path(__file__).parents[1] / "docs/howto/verdict.md").read_text()
    keys = schema()["required"] + schema()["$defs"]["effect"]["required"]
    assert not [key for key in keys if f"`{key}`" not in page]
    assert f"`{SCHEMA}`, {VERSION}" in page


def test_the_headline_says_the_largest_gap_and_what_closes_it():
    said = VERDICT.headline
    assert said.startswith("The largest gap is in the electrodes, 10 counts RMS where 2 counts are noise")
    assert said.endswith("with warm-up (or temperature) added it is 4 counts.")
    other = dataclasses.replace(WARM, id="thermal", name="temperature", ties={"warmup": "warm-up"})
    both = dataclasses.replace(VERDICT, effects=[WARM, other], unknown=True)
    assert both.headline.count("temperature") == 1 and "for the rest no cause is known" in both.headline
    doubtful = dataclasses.replace(VERDICT, effects=[dataclasses.replace(WARM, confirmed=False)])
    assert "held-out data contradict it" in doubtful.headline and "added" not in doubtful.headline
    assert "no known cause" in dataclasses.replace(VERDICT, effects=[]).headline
    there = dataclasses.replace(VERDICT, lead="force").headline
    assert there.startswith("The largest gap is in the force, 0.3 N RMS; with warm-up (or temperature) ")
    assert there.endswith("(or temperature) 10 counts in the electrodes become 4.")
    agree = dataclasses.replace(VERDICT, effects=[], significant=False)
    assert "agree within" not in agree.headline and "may be off by" in agree.headline
    small = {"electrodes": Gap("counts", 2.03, 2.03, 2.0, "the electrodes")}
    assert "agree within noise" in dataclasses.replace(agree, gap=small).headline


def test_a_headline_says_where_nothing_is_gained():
    same = Gap("counts", 2.031, 2.028, 1.0, "the electrodes")
    force = Gap("N", 0.3, 0.2, 0.2, "the force")
    unproved = dataclasses.replace(VERDICT, effects=[dataclasses.replace(WARM, gap=None, confirmed=None)])
    said = dataclasses.replace(unproved, gap={"electrodes": same}).headline
    assert said.endswith("; found beside it, with no share in it: warm-up (or temperature).")
    little = Gap("N", 0.3, 0.297, 0.2, "the force")
    assert dataclasses.replace(unproved, gap={"electrodes": same, "force": little}).headline == said
    said = dataclasses.replace(VERDICT, gap={"electrodes": same}).headline  # what confirms it is said
    assert said.endswith("10 counts in level of all electrodes become 2.") and "added" not in said
    said = dataclasses.replace(VERDICT, gap={"electrodes": same, "force": force}).headline
    assert said.startswith("The largest gap is in the electrodes, 2.03 counts RMS where 1 counts are noise")
    assert said.endswith("; with warm-up (or temperature) 0.3 N in the force become 0.2.")


def test_the_summary_has_effect_proof_gap_and_what_is_unknown():
    text = summary(VERDICT)
    assert text.startswith(VERDICT.headline)
    for part in (
        "warm-up [transduction], all electrodes, confidence 0.90, 0.0 s to 60.0 s",
        "tau 100 s (90 .. 99)",
        "level of all electrodes: 10 -> 2 counts, noise 1 (confirmed)",
        "not told from temperature: record TDC",
        "no TDC: whether it is warmth",
        "next experiment: record TDC",
    ):
        assert part in text, part


def test_what_a_gap_closes_is_of_what_is_above_noise():
    assert Gap("counts", 5.0, 3.0, 3.0).closed == pytest.approx(1.0)
    assert Gap("counts", 5.0, 4.0).closed == pytest.approx(9 / 25), "noise that nobody knows counts as none"
    assert math.isnan(Gap("counts", 1.0, 1.0, 1.0).closed)
    assert Gap("N", 1.0, 1.0, 1e-6).floor == "none"


def test_a_parameter_at_its_bound_says_so():
    at, inside = (Estimate.of(Param("s", 1, 100, "minutes", 60.0), value) for value in (100.0, 50.0))
    assert at.to_dict()["at_bound"] and not inside.to_dict()["at_bound"]
    assert str(inside) == "50 s" and str(Estimate(0.5, 0.4, 0.6)) == "0.5 (0.4 .. 0.6)"


def test_curves_have_a_panel_for_each_channel():
    time = np.linspace(0, 1, 50)
    panels = [plots.Panel(f"e{k}", "counts", time, time, time, None, (0.7, 1.0)) for k in range(6)]
    figure = plots.curves([panels[:3], panels[3:]])
    assert [ax.get_title() for ax in figure.axes] == [one.title for one in panels]
    assert [len(ax.lines) for ax in figure.axes] == [2] * 6
    figure.canvas.draw()
    assert all(any(t.get_text() and t.get_visible() for t in ax.get_yticklabels()) for ax in figure.axes)


def test_a_channel_without_measurement_says_so_beside_its_name():
    gap = Gap("counts", 3.0, 2.0, 0.5, "a", ("e1", "e2"), (3.0, math.nan), (2.0, math.nan))
    (ax,) = plots.channels([gap]).axes
    assert [(t.get_text().strip(), t.get_position()[0]) for t in ax.texts] == [("no measurement", 1)]


def test_a_report_opens_with_the_channel_that_is_most_off():
    gap = Gap(
        "counts", 10.0, 4.0, 2.0, "the electrodes", ("e1", "e2", "e3"), (3.0, 16.0, math.nan), (3.0, 5.0, 1.0)
    )
    shown = page(dataclasses.replace(VERDICT, gap={"electrodes": gap}))
    assert "e2, 16 counts RMS, amended 5" in shown.split("<h2>")[0]
    assert VERDICT.next_command in shown.split("<h2>")[0]
