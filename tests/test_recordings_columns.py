"""Text of named columns, in the forms that loggers and spreadsheets write."""

import numpy as np
import pytest

from biotac_mj.recordings.formats.columns import read_columns

NAMES = ("Fx", "Fy", "Fz")
ROWS = np.array([[0.5, -1.25, 3.0], [1e-3, 2.0, -4.5]])


def lines(delimiter=" ", end="\n", rows=ROWS):
    return end.join(delimiter.join(f"{v:g}" for v in row) for row in rows) + end


@pytest.mark.parametrize(
    "text",
    [
        lines(),
        lines("\t", "\r\n"),
        lines(","),
        lines(";"),
        "\ufeff" + lines(", "),
        "# force plate\n% N\n\n" + lines() + "\n",
        "Fx,Fy,Fz\n" + lines(","),
        "# Fx Fy Fz\n" + lines(),
        "0,1,2\n" + lines(","),
        lines(";").replace(".", ","),
        lines("\t").replace(".", ","),
        lines().replace(".", ","),
        lines("|"),
        lines("\t,"),
        '"Fx","Fy","Fz"\n"0,5","-1,25","3"\n"0.001","2","-4,5"\n',
        lines('";"', end='"\n"').removesuffix('"').join('""').removesuffix('"'),
        lines(",", ",\n"),
        "force_x force_y force_z\n" + lines(),
        "'fx' 'fy' 'fz'\n" + lines(),
        "time,fz,fx,note,fy\n" + lines(",", rows=np.c_[[0, 1], ROWS[:, 2], ROWS[:, 0], [7, 7], ROWS[:, 1]]),
    ],
)
def test_forms_of_a_table(tmp_path, text):
    path = tmp_path / "f.txt"
    path.write_bytes(text.encode())
    np.testing.assert_array_equal(read_columns(path, NAMES), ROWS)


def test_a_file_of_one_column_is_read(tmp_path):
    (tmp_path / "t.txt").write_text("tdc\n1\n2\n")
    np.testing.assert_array_equal(read_columns(tmp_path / "t.txt", ("tdc",)), [[1], [2]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty: 3 columns of numbers, Fx Fy Fz"),
        ("Fx Fy Fz\n", "is empty"),
        ("1 2 3 4\n", r"line 1: 4 columns, 3 are needed \(Fx Fy Fz\); leave out times"),
        ("1 2 3\n\n1 2\n", "line 3: 2 columns"),
        ("fx fy\n1 2\n", "has no columns Fz: its header must name Fx Fy Fz"),
        ("1 2 3\n1 x 3\n1 2 y\n", r"line 2: Fy is 'x', not a finite number \(2 such cells\)"),
        ("1 2 3\n# a\n1 inf 3\n", "line 3: Fy is 'inf'"),
        ("x 2 3\n1 2 3\n", "line 1: Fx is 'x'"),
        (
            "nan nan nan\n1 2 3\n",
            r"line 1: Fx is 'nan', not a finite number \(3 such cells\): a gap cannot be guessed",
        ),
        ("1,5,2,5,3,5\n", "line 1: 6 columns"),
        (
            "fx fy fz\nsn sn sn\n1 2 3\n",
            "line 2: no number in it .sn, sn, sn.: remove all lines but one of the header",
        ),
        ("fx fy fz\n1 2 3\nfx fy fz\n1 2 3\n", "line 3: no number in it"),
        ("Logged by\nhand, today\nfx,fy,fz\n1,2,3\n", "line 2: no number in it"),
        ("time,fx,fy,fz\n0,0.1,1,2,3\n1,0.2,1,2,3\n", "line 2: 5 columns, and the header names 4: which is"),
        ("fx,fy,fz,time\n1,2,3\n1,2,3\n", "line 2: 3 columns, and the header names 4"),
    ],
)
def test_bad_tables_are_named(tmp_path, text, message):
    path = tmp_path / "f.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_columns(path, NAMES)


def test_rows_shorter_than_their_header_are_refused(tmp_path):
    path = tmp_path / "electrodes.csv"
    path.write_text("x,y,z\n1,2\n")
    with pytest.raises(ValueError, match="line 2: 2 columns, and the header names 3: give each row"):
        read_columns(path, ["x", "y", "z"])


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(
        FileNotFoundError, match="none.txt: no such file; give a text file with 19 columns, e1..e19"
    ):
        read_columns(tmp_path / "none.txt", [f"e{i}" for i in range(1, 20)])
