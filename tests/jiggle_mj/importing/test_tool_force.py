"""The force on the tool of a folder of points: one row a frame, in the world's axes, or a refusal."""

import numpy as np
import pytest

from jiggle_mj.errors import RecordingError
from tests.support.measured_folder import TOML, bring_in, folder

ROWS = "fx;fy;fz\n0;0;0\n10;20;30\n11;nan;31\n"
TABLE = '[force]\nfile = "force.csv"\nunit = "mN"\n'
TURNED = "[frame]\nrotation = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]\n"


def imported(tmp_path, table: str = TABLE, rows: str = ROWS, toml: str = TOML):
    where = folder(tmp_path, toml=toml + table)
    (where / "force.csv").write_text(rows)
    return [each.force for each in bring_in(where)[1]]


def test_a_force_is_read_in_newton_and_in_the_axes_of_the_world(tmp_path):
    """A quarter turn about z takes (x, y) to (-y, x); a row that is not finite has no force."""
    first, second, third = imported(tmp_path, TABLE + "sd = 2e-3\n" + TURNED)
    assert third is None and first.sd == second.sd == 2e-3
    np.testing.assert_allclose(second.on_tool, [-0.02, 0.01, 0.03], atol=1e-12)


def test_a_force_on_the_tissue_is_turned(tmp_path):
    _, second, _ = imported(tmp_path, TABLE + 'acts = "on tissue"\n')
    assert second.sd is None
    np.testing.assert_allclose(second.on_tool, [-0.01, -0.02, -0.03], atol=1e-12)


@pytest.mark.parametrize(
    "rows",
    [
        "Fx [mN];Fy [mN];Fz [mN]\n0,5;0,25;0,5\n10,5;20,25;30,5\n;;\n",
        "Fx;Fy;Fz\nmN;mN;mN\n0,5;0,25;0,5\n10,5;20,25;30,5\nNA;NA;NA\n",
        "force_x\tforce_y\tforce_z\n0,5\t0,25\t0,5\n10,5\t20,25\t30,5\n\t\tNaN\n",
        "# Fx Fy Fz\n0.5 0.25 0.5\n10.5 20.25 30.5\ninf nan 1\n",
    ],
    ids=["decimal-comma", "line-of-units", "tabs", "blanks"],
)
def test_a_file_is_read_as_files_of_points_are(tmp_path, rows):
    _, second, third = imported(tmp_path, rows=rows)
    assert third is None
    np.testing.assert_allclose(second.on_tool, [0.0105, 0.02025, 0.0305], atol=1e-12)


@pytest.mark.parametrize(
    ("table", "rows", "message"),
    [
        (TABLE, "0,0,0\n1,1,1\n", r"numbers of shape \(3, 3\).* it has \(2, 3\)"),
        (TABLE, "0 0 0\n1 1 a\n1 1 1\n", "line 2 holds text that is not a number"),
        (TABLE, "0,0,0\n1,1\n1,1,1\n", "line 2 has 2 columns"),
        (TABLE, "nan,nan,nan\n0,,1\nNA,NA,NA\n", "no row of three finite numbers"),
        (TABLE, "Fy;Fx;Fz\n0;0;0\n1;2;3\n1;2;3\n", "must be x, y and z in this order"),
        (TABLE, "fx,fz,fy\n0,0,0\n1,2,3\n1,2,3\n", "must be x, y and z in this order"),
        (TABLE, "Fx [N],Fy [N],Fz [N]\n0,0,0\n1,2,3\n1,2,3\n", "forces are in N: give that unit"),
        (TABLE, "Fx,Fy,Fz\n[N],[N],[N]\n0,0,0\n1,2,3\n1,2,3\n", "forces are in N: give that unit"),
        (TABLE, "fx_gf fy_gf fz_gf\n0 0 0\n1 2 3\n1 2 3\n", "forces are in gf: give that unit"),
        (TABLE.replace("mN", "N"), "0 0 0\n1 1 1\n1 1 2e5\n", "at most 10000 N are read"),
        (TABLE.replace("mN", "kg"), ROWS, "unit must be one of N, mN, cN"),
        (TABLE.replace('file = "force.csv"', ""), ROWS, "needs values, an array"),
        (TABLE + 'acts = "tool"', ROWS, "acts must be one of 'on tool', 'on tissue'"),
        (TABLE + "noise = 1", ROWS, "unknown key 'noise'"),
    ],
)
def test_a_mistake_is_refused(tmp_path, table, rows, message):
    with pytest.raises(RecordingError, match=message):
        imported(tmp_path, table, rows)
