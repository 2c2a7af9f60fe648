"""What can be wrong with a recording that somebody brings: a row is a command, what is broken, and what is
said.

A row ends in one line on stderr that holds the row's text, exit code 2, and nothing is written."""

import gzip
import json
import pickle
import shutil

import numpy as np
import pytest
import scipy.io
from bad_rows import Row, h5, replaced
from recorded import synthetic, write_btd, write_csv, write_mat

from biotac_mj import cli
from biotac_mj.recordings import FIELDS, write


def put(name, value):
    """Another value for a data set: a function of the old one, or a value."""

    def do(file):
        old, unit = file[name][()], file[name].attrs["unit"]
        del file[name]
        file[name] = value(old) if callable(value) else value
        file[name].attrs["unit"] = unit

    return h5(do)


def attribute(name, value, group="/"):
    def do(file):
        if value is None:
            del file[group].attrs[name]
        else:
            file[group].attrs[name] = value

    return h5(do)


def text(value):
    return lambda path: path.write_text(value)


def lines(change):
    def do(path):
        path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")

    return do


def column(name, change):
    """Another column of a CSV file."""

    def do(path):
        head, *rows = path.read_text().splitlines()
        k = head.split(",").index(name)
        words = [row.split(",") for row in rows]
        for i, row in enumerate(words):
            row[k] = change(i, row[k])
        path.write_text("\n".join([head, *map(",".join, words)]) + "\n")

    return do


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def variables(**changes):
    """Other variables of a MATLAB file; None leaves one out."""

    def do(path):
        found = {k: v for k, v in scipy.io.loadmat(path).items() if not k.startswith("__")}
        for name, value in changes.items():
            found[name] = value(found[name]) if callable(value) else value
        scipy.io.savemat(path, {k: v for k, v in found.items() if v is not None})

    return do


class Rogue:
    """Unpickled, it would make a file."""

    def __reduce__(self):
        return open, ("unpickled", "w")


# --- the table

REC, CSV, TXT = (
    "recording show rec.h5 --out out.png",
    "recording import r.csv --out out.h5",
    "recording import e.txt --out out.h5",
)
MAT, BTD, TWO = (
    "recording import r.mat --out out.h5",
    "recording import r.btd --out out.h5",
    "recording import e.txt f.txt --out out.h5",
)


def strange(file):
    """Another HDF5 file: none of the names that are known."""
    file.clear()
    del file.attrs["schema"]
    file["a"], file["b"] = np.arange(9.0), np.arange(9)


def native():
    yield Row(REC, "nothing that is known of a BioTac (a, b)", "rec.h5", h5(strange))
    yield Row(
        REC, "schema 'biotac_mj.recording/9': this", "rec.h5", attribute("schema", "biotac_mj.recording/9")
    )
    yield Row(REC, "rec.h5 is a shard of a data set", "rec.h5", attribute("schema", "biotac_mj.data/1"))
    yield Row(REC, "synthetic of rec.h5 has no time", "rec.h5", h5(lambda f: f.__delitem__("synthetic/time")))
    yield Row(
        REC,
        "has jelly: only time, electrodes",
        "rec.h5",
        h5(lambda f: f.create_dataset("synthetic/jelly", data=1)),
    )
    yield Row(REC, "arrays outside of them", "rec.h5", h5(lambda f: f.create_dataset("jelly", data=[1.0])))
    yield Row(REC, "rec.h5 has no recordings", "rec.h5", h5(lambda f: f.__delitem__("synthetic")))
    for name in ("object", "source", "frame", "rate_source", "notes"):
        yield Row(REC, f"has no attribute {name}", "rec.h5", attribute(name, None, "synthetic"))
    yield Row(REC, "rec.h5 is no recording (Expecting", "rec.h5", attribute("notes", "no", "synthetic"))
    yield Row(REC, "attribute notes of synthetic", "rec.h5", attribute("notes", json.dumps({}), "synthetic"))
    yield Row(REC, "electrodes is in 'ohm'", "rec.h5", attribute("unit", "ohm", "synthetic/electrodes"))
    for name in ("time", *FIELDS):
        if name in ("contact_pos", "sensor_pos", "sensor_quat"):
            continue
        one = f"synthetic/{name}"
        yield Row(REC, f"{name} of synthetic of rec.h5 has shape", "rec.h5", put(one, lambda v: v[..., None]))
        yield Row(REC, "of synthetic of rec.h5 has shape", "rec.h5", put(one, lambda v: v[1:]))
        yield Row(
            REC, f"{name} of synthetic of rec.h5 holds", "rec.h5", put(one, lambda v: np.full(v.shape, b"a"))
        )
    yield Row(REC, "time does not increase", "rec.h5", put("synthetic/time", lambda v: v[::-1]))
    yield Row(
        REC, "time of synthetic of rec.h5 has values", "rec.h5", put("synthetic/time", lambda v: v * np.nan)
    )
    yield Row(REC, "pdc has infinite numbers", "rec.h5", put("synthetic/pdc", lambda v: v * np.nan))
    yield Row(REC, "e1 of row 0 is 8", "rec.h5", put("synthetic/electrodes", lambda v: 4 * v))
    yield Row(REC, "no unit quaternions", "rec.h5", put("synthetic/object_quat", lambda v: 2 * v))
    yield Row(
        REC, "object_pos reaches 1e+03: metres", "rec.h5", put("synthetic/object_pos", lambda v: v + 1e3)
    )
    yield Row(REC, "these look like mN", "rec.h5", put("synthetic/force", lambda v: 1e3 * v))
    yield Row(REC, "rec.h5 is no recording (", "rec.h5", cut)
    hole = put("synthetic/electrodes", lambda v: np.where(np.arange(len(v))[:, None] == 7, np.nan, v))
    yield Row("learn judge rec.h5 --quiet", "lacks electrodes in 1 rows, the first is row 7", "rec.h5", hole)
    yield Row(
        "learn judge rec.h5 --recording jelly --quiet", "0 recordings called 'jelly': choose one of synthetic"
    )
    yield Row("learn train e.txt --out m.safetensors", "no model can be kept: give --force")
    short = lines(lambda v: v[:1])
    yield Row("learn judge e.txt --quiet", "e has 1 rows: at least 400 are needed", "e.txt", short)
    yield Row("learn predict m.safetensors e.txt", "`biotac learn train")
    yield Row("learn judge trained --recording a", "trained: no such file")


def tables():
    yield Row(TXT, "e.txt is empty", "e.txt", text(""))
    yield Row(TXT, "e.txt is empty", "e.txt", text("# a\n% b\n"))
    yield Row(
        TXT,
        "e.txt, line 9: 5 columns, 19 are needed as in line 1",
        "e.txt",
        lines(lambda v: [*v[:8], "1 2 3 4 5", *v[9:]]),
    )
    yield Row(
        TXT, "line 3: e1 is 'inf', not a finite", "e.txt", lines(lambda v: [*v[:2], "inf" + v[2][4:], *v[3:]])
    )
    yield Row(TXT, "e.txt is no recording: it holds bytes", "e.txt", lambda p: p.write_bytes(bytes(999)))
    yield Row(
        TXT,
        "e.txt is no recording: it holds bytes",
        "e.txt",
        lambda p: p.write_bytes(pickle.dumps([Rogue(), 0.0])),
    )
    yield Row(TXT, "line 1: 26 columns, 19 are needed", "e.txt", lines(lambda v: [" ".join(["7"] * 26)] * 30))
    yield Row(TXT, "line 1: 20 columns, 19 are needed", "e.txt", lines(lambda v: ["7 " + row for row in v]))
    yield Row(TXT, "e.txt is empty: it has a header and no rows", "e.txt", text("time e1 e2\n"))
    yield Row(
        TXT,
        "e.txt is a damaged .gz file",
        "e.txt",
        lambda p: p.write_bytes(gzip.compress(p.read_bytes())[:-99]),
    )
    yield Row(TXT, "raw counts 0..4095 are needed", "e.txt", lines(lambda v: ["4096" + v[0][4:], *v[1:]]))
    yield Row(f"{TXT} --rate 0", "--rate")
    yield Row(f"{TXT} --scale nan", "--scale")
    yield Row("recording import nowhere --out out.h5", "nowhere: no such file")
    yield Row(
        "recording import folder --out out.h5", "folder: no such file: it is a folder, and no ROS 2 bag"
    )
    yield Row("recording import e.txt e.txt --out out.h5", "given twice")
    copied = lambda p: p.write_bytes(gzip.compress((p.parent / "f.txt").read_bytes()))  # noqa: E731
    yield Row(
        "recording import f.txt f.txt.gz --out out.h5",
        "no electrodes: give the sensor's own",
        "f.txt.gz",
        copied,
    )
    yield Row("recording import e.txt --out folder", "folder is a folder")
    yield Row("recording import e.txt --out e.txt/a.h5", "e.txt is a file")
    yield Row("recording import --out out.h5", "the following arguments are required: FILE")
    yield Row(TWO, "e.txt has 420 rows and f.txt has 419", "f.txt", lines(lambda v: v[1:]))
    yield Row(TWO, "these look like mN", "f.txt", lines(lambda v: [row.replace("-", "-9999") for row in v]))
    yield Row(TWO, "could be anything: give the", "f.txt", lines(lambda v: ["1 2 3 4 5 6 7 8"] * 420))
    yield Row(TWO, "f.txt, line 2: Fy is 'x'", "f.txt", lines(lambda v: [v[0], "1 x 3", *v[2:]]))


def hexadecimal(head):
    """A log in hexadecimal counts."""
    return lines(lambda v: [" ".join(f"{head}{int(float(word)):x}" for word in row.split()) for row in v])


def words():
    """What loggers write that is no number: units, hexadecimal counts, clocks."""
    units = lines(lambda v: [v[0], ",".join(["s"] + ["[V]"] * v[0].count(",")), *v[1:]])
    yield Row(CSV, "line 2: no number in it (s, ", "r.csv", units)
    yield Row(CSV, "such as a row of units", "r.csv", units)
    one = column("pdc", lambda i, v: "counts" if i == 0 else v)
    yield Row(
        CSV,
        "line 2: pdc is 'counts', not a finite number (1 such cells): is this line a row of",
        "r.csv",
        one,
    )
    yield Row(TXT, "e.txt, line 1: 0x", "e.txt", hexadecimal("0x"))
    yield Row(TXT, "is hexadecimal: write decimal numbers, here ", "e.txt", hexadecimal("0x"))
    yield Row(
        TXT, "? Write decimal numbers, here ", "e.txt", text("7d0 " * 18 + "7d1\n" + "7d0 " * 18 + "7d2\n")
    )
    late = column("e3", lambda i, v: "0x7d0" if i == 9 else v)
    yield Row(CSV, "line 11: e3 is '0x7d0', not a finite number (1 such cells): 0x7d0 is hex", "r.csv", late)
    yield Row(CSV, "(420 such cells): is 7DF hexadecimal?", "r.csv", column("e3", lambda i, v: "7DF"))
    for clock in ("34:56.7", "1/2/2026 12:34", "12:34:56 PM"):
        told = column("time", lambda i, v, clock=clock: clock)
        yield Row(CSV, "is this a time? What is read is seconds, a time of day as 12:34:56.7", "r.csv", told)
    dated = lines(lambda v: [f"2026-01-01 12:00:{k:02d} {row}" for k, row in enumerate(v[:50])])
    yield Row(TXT, "is '2026-01-01', not a finite number (100 such cells): is this a time?", "e.txt", dated)
    day = column("time", lambda i, v: f"12:34:{i / 8:.3f}" if i != 7 else "noon")
    yield Row(CSV, "line 9: time is 'noon', no time as '12:34:0.000' in line 2: correct or", "r.csv", day)
    day = column("time", lambda i, v: f"12:34:{i / 8:06.3f}" if i != 7 else "25:00:00")
    yield Row(CSV, "line 9: time is '25:00:00', no time as '12:34:00.000'", "r.csv", day)


def csv():
    yield Row(CSV, "r.csv has no columns e7", "r.csv", replaced(",e7,", ",jelly,"))
    for other in ("e0", "e20"):
        yield Row(CSV, "r.csv has 20 columns of electrodes, e", "r.csv", replaced(",pdc,", f",{other},"))
    yield Row(CSV, "is known of a BioTac (a, b): name them e1..e19", "r.csv", text("a,b\n1,2\n1,2\n"))
    yield Row(CSV, "line 6: e3 is 'x'", "r.csv", column("e3", lambda i, v: "x" if i == 4 else v))
    odd = column("e3", lambda i, v: "" if i % 2 else v)
    even = column("e4", lambda i, v: v if i % 2 else "")
    turns = lambda path: (odd(path), even(path))  # noqa: E731
    yield Row(CSV, "420 of 420 rows lack an electrode, mostly e3: a gap cannot", "r.csv", turns)
    dynes = replaced(",pdc,", ",Fx (dyn),")
    known = "N, mN, cN, daN, kN, gf, kgf, ozf, lbf are known"
    yield Row(CSV, f"column 'Fx (dyn)' has unit dyn: {known}", "r.csv", dynes)
    volts = replaced(",e3,", ",e3 [mV],")
    yield Row(CSV, "the electrodes are in mV; raw counts 0..4095 are needed: give --scale", "r.csv", volts)
    untimed = lines(lambda v: [row.partition(",")[2] for row in v])
    one = column("e3", lambda i, v: "" if i == 0 else v)
    yield Row(CSV, "line 2: e3 is '', not a finite", "r.csv", lambda path: (untimed(path), one(path)))
    twice = replaced(",e7,", ",e8,")
    yield Row(CSV, "r.csv has several columns called e8: rename", "r.csv", twice)
    both = replaced(",e7,", ",ele8,")
    yield Row(CSV, "r.csv has two columns for electrodes 8, ele8 and e8", "r.csv", both)
    yield Row(CSV, "line 2: no number in it", "r.csv", lines(lambda v: ["made by hand", *v]))
    yield Row(CSV, "line 5: no number in it", "r.csv", lines(lambda v: [*v[:4], v[0], *v[4:]]))
    yield Row(CSV, "line 2: time is 'noon'", "r.csv", column("time", lambda i, v: "noon"))
    yield Row(CSV, "line 2: time is 'nan'", "r.csv", column("time", lambda i, v: "nan" if i == 0 else v))
    yield Row(CSV, "is no clock", "r.csv", column("time", lambda i, v: "7"))
    yield Row(CSV, "turn the rows around", "r.csv", column("time", lambda i, v: f"{7 - 1e-3 * i}"))
    yield Row(
        CSV, "are not in the order of their times", "r.csv", column("time", lambda i, v: f"{37 * i % 101}")
    )
    yield Row(
        CSV, "0.01 rows per second are no log of a BioTac", "r.csv", column("time", lambda i, v: f"{100 * i}")
    )
    yield Row(CSV, "1e+05 rows per second", "r.csv", column("time", lambda i, v: f"{1e-5 * i:.6f}"))
    yield Row(CSV, "r.csv has no columns e1..e19: its header must", "r.csv", text("Fx,Fy,Fz\n1,2,3\n"))
    yield Row(
        "recording import r.csv w_cp.csv --out out.h5",
        "have no time in common",
        "w_cp.csv",
        text("time,posx,posy,posz\n900,0,0,0\n900.1,0,0,0\n"),
    )
    yield Row(
        "recording import r.csv w_cp.csv --out out.h5",
        "metres are needed",
        "w_cp.csv",
        text("time,posx,posy,posz\n5,900,0,0\n6,900,0,0\n7,900,0,0\n"),
    )
    wide = text("time,posx,posy,posz\n5,0,0,0\n9,0,0\n")
    yield Row(
        "recording import r.csv w_cp.csv --out out.h5", "w_cp.csv, line 3: 3 columns, 4 are", "w_cp.csv", wide
    )


def others():
    yield Row(MAT, "r.mat is no MATLAB file", "r.mat", cut)
    yield Row(MAT, "r.mat is no .mat file, whatever", "r.mat", text("no"))
    yield Row(
        MAT, "electrodes has shape (18, 420): (n, 19) or", "r.mat", variables(F0Electrodes=lambda v: v[1:])
    )
    yield Row(MAT, "r.mat has columns of 420, 421 rows", "r.mat", variables(F0pdc=lambda v: np.c_[v, 0]))
    yield Row(
        MAT,
        "nothing that is known of a BioTac (a)",
        "r.mat",
        lambda p: scipy.io.savemat(p, {"a": np.ones(9)}),
    )
    yield Row(MAT, "electrodes has shape (3,): (n, 19)", "r.mat", variables(F0Electrodes=np.ones(3)))
    yield Row(
        MAT, "nothing that is known of a BioTac (no columns)", "r.mat", lambda p: scipy.io.savemat(p, {})
    )
    yield Row(BTD, "without 'Begin File'", "r.btd", replaced("Begin File", "Begin"))
    yield Row(BTD, "r.btd has no samples", "r.btd", lines(lambda v: v[:-1] + [v[-1][:20]]))
    yield Row(BTD, "r.btd has no samples", "r.btd", lines(lambda v: v[:4]))
    yield Row(BTD, "no whole frame", "r.btd", lines(lambda v: v[:40]))
    yield Row(
        BTD,
        "no whole frame",
        "r.btd",
        lines(lambda v: v[:4] + [row.replace(" 17 ", " 99 ") for row in v[4:]]),
    )
    yield Row(
        BTD, "samples that are not finite", "r.btd", lines(lambda v: v[:4] + ["nan" + v[4][8:], *v[5:]])
    )
    yield Row(
        "recording import a.bag --out out.h5",
        "a.bag is",
        "a.bag",
        lambda p: p.write_bytes(b"#ROSBAG V2.0\n" + bytes(99)),
    )
    yield Row("recording import a.mcap --out out.h5", "a.mcap is no .mcap file", "a.mcap", text("no"))
    yield Row("learn judge rec.h5 --force f.txt", "f.txt cannot be put beside synthetic, which is complete")
    yield Row("recording record --out out.h5", "one of the arguments --topic --serial is required")
    yield Row("recording record --topic /a --serial b --out out.h5", "not allowed with")
    yield Row("recording record --topic /a --seconds -1 --out out.h5", "--seconds")


ROWS = [row for table in (native, tables, words, csv, others) for row in table()]


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder, one = tmp_path_factory.mktemp("good"), synthetic()
    write(folder / "rec.h5", [one])
    np.savetxt(folder / "e.txt", one.electrodes, "%d")
    np.savetxt(folder / "f.txt", one.force, "%.4f")
    write_csv(folder / "r.csv", one)
    write_mat(folder / "r.mat", one)
    write_btd(folder / "r.btd", one.rows(slice(0, 5)))
    (folder / "folder").mkdir()
    return folder


@pytest.mark.parametrize("row", ROWS, ids=str)
def test_a_bad_recording_is_one_line(row, good, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(good, tmp_path, dirs_exist_ok=True)
    if row.file:
        row.change(tmp_path / row.file)
    before = sorted(tmp_path.rglob("*"))
    try:
        code = cli.main(row.words.split())
    except SystemExit as stop:  # argparse's
        code = stop.code
    said = capsys.readouterr().err
    assert row.text in said and said.startswith("biotac: error: ") and said.count("\n") == 1, said
    assert code == 2 and sorted(tmp_path.rglob("*")) == before


def test_the_table_is_long_enough():
    assert len(ROWS) >= 40


@pytest.mark.parametrize("words", ["recording show rec.h5 --out out.png", CSV, TXT, TWO, MAT, BTD])
def test_the_files_are_good_before(words, good, tmp_path, monkeypatch):
    monkeypatch.chdir(good)
    assert cli.main([*words.split()[:-1], str(tmp_path / words.split()[-1])]) == 0
