from __future__ import annotations

import pytest

from .runs import BENCHMARKS

ROOT = BENCHMARKS.parent
ENTRY = {
    "script": "parity.py",
    "quick": False,
    "machine": {"cores": 2, "cpu": "Zuse Z3", "memory_gb": 24.7, "python": "3.11.7"},
    "commit": "0123456789ab",
    "started": "2026-11-27T09:00:00+00:00",
    "dirty": False,
    "load_before": [1.5, 1.0, 1.0],
    "state": "met",
    "failures": [],
    "error": None,
}
RESULT = {
    "rate": 487654.3,
    "small": 1.34e-06,
    "share": 0.9841,
    "none": None,
    "robots": {"a": {"rmse": 0.001}, "b": {"rmse": 0.003}},
    "rows": [{"ratio": 9.44}, {"ratio": 13.3}],
    "two words": {"by/slash": 3},
    "nested": {},
    "name": "office",
}


@pytest.fixture
def tables(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from measuring import tables

    return tables


def page(tables, **changes):
    return tables.Page({"runs": {"parity": {**ENTRY, "result": RESULT, **changes}}})


@pytest.mark.parametrize(
    ("template", "text"),
    [
        ("{rate|.1e} a second", "4.9e5 a second"),
        ("{rate|,.0f}", "487,654"),
        ("{small|.1e}", "1.3e-6"),
        ("{share|.1%}", "98.4 %"),
        ("{share x100|.0f}", "98"),
        (
            "{min robots.*.rmse x1000|.0f} to {max robots.*.rmse x1000|.0f} mm",
            "1 to 3 mm",
        ),
        ("{max rows.*.ratio|.1f}, {rows.0.ratio|.1f}", "13.3, 9.4"),
        ("{two words.by/slash}", "3"),
        ("{name}", "office"),
        ("{parity:rate|.1e}", "4.9e5"),
        ("no figure", "no figure"),
        ("{nothing}", "not measured"),
        ("{none}", "not measured"),
        ("{rate.deeper}", "not measured"),
        ("{rows.7.ratio}", "not measured"),
        ("{max nested.*.rmse}", "not measured"),
        ("{name|.1f}", "not measured"),
        ("{robots}", "not measured"),
        ("{soak:rate}", "not measured"),
        ("{rate|.1e} of {nothing}", "not measured"),
    ],
)
def test_a_cell_is_written_from_what_was_measured_or_says_that_it_was_not(
    tables, template, text
):
    assert page(tables).cell(template, "parity")[0] == text


def test_a_table_of_a_run_that_missed_its_bar_shows_it(tables):
    table = tables.Table(
        ("what", ""), (("parity", "rate", "{rate|.1e}"), ("parity", "", "x"))
    )
    told = page(tables, state="missed", failures=["rate: 4.9e5, bar 9e5"]).table(table)
    assert told == (
        "| what | |\n|---|---|\n| rate | 4.9e5 † |\n| | x |\n"
        "\n† `parity.py` missed: rate: 4.9e5, bar 9e5\n"
    )
    many = page(
        tables, state="missed", failures=["a: 1", "b: 2", "c: 3", "d: 4"]
    ).table(table)
    assert many.endswith("† `parity.py` missed: a: 1; b: 2; and 2 more\n")
    broken = page(tables, state="broken", result=None, error="was ended").table(table)
    assert "| rate | not measured |" in broken
    assert "† `parity.py` broken: was ended" in broken
    assert "‡ `parity.py`: a short run" in page(tables, quick=True).table(table)


def test_a_table_without_notes_keeps_the_marks(tables):
    table = tables.Table(("what",), (("parity", "{rate|.1e}"),), notes=False)
    missed = page(tables, state="missed", failures=["rate: 4.9e5, bar 9e5"])
    assert missed.table(table) == "| what |\n|---|\n| 4.9e5 † |\n"


def test_the_first_screen_has_eight_figures_and_all_are_measured(tables):
    text = tables.open_page().text("first_screen")
    assert text.count("\n") == 2 + 8
    assert "not measured" not in text


def test_the_machine_the_commit_and_the_load_are_told(tables):
    told = page(tables, dirty=True).text("machine")
    for words in (
        "2 shared cores (Zuse Z3) with 25 GB",
        "Python 3.11.7",
        "789ab and changes",
    ):
        assert words in told
    assert "1.5 to 1.5" in told
    assert "measured yet" in tables.Page({}).text("machine")


def test_what_was_measured_on_another_machine_than_most_is_marked(tables):
    entry = {**ENTRY, "result": RESULT}
    away = {**entry, "machine": {**ENTRY["machine"], "cpu": "Analytical Engine"}}
    found = tables.Page({"runs": {"parity": entry, "soak": entry, "shield": away}})
    table = tables.Table(("",), (("parity", "{rate|.0e}"), ("shield", "{rate|.0e}")))
    told = "§ on 2 shared cores (Analytical Engine)\n"
    assert found.table(table) == f"| |\n|---|\n| 5e5 |\n| 5e5 § |\n\n{told}"
    assert "or on 2 shared cores (Analytical Engine) where marked §" in found.text(
        "machine"
    )
    assert "§" not in page(tables).text("machine")
    more = {**entry, "machine": {**ENTRY["machine"], "cores": 16}}
    found = tables.Page({"runs": {"parity": entry, "soak": entry, "shield": more}})
    assert "§ on 16 shared cores (Zuse Z3)" in found.table(table)


def test_every_table_is_written_whatever_there_is(tables):
    for results in ({}, {"runs": {"parity": {**ENTRY, "result": {"runs": []}}}}):
        for name in tables.TABLES:
            assert "not measured" in tables.Page(results).text(name)


def test_a_region_is_made_anew_and_all_else_stays(tables, monkeypatch):
    table = tables.Table(("",), (("parity", "{rate|.0e}"),))
    monkeypatch.setitem(tables.TABLES, "parity", table)
    before = "a\n\n<!-- results:parity -->\nold\n<!-- /results -->\n\nb\n"
    assert tables.rendered(before, page(tables)) == before.replace(
        "old", "| |\n|---|\n| 5e5 |"
    )


def test_a_region_that_no_table_has_is_an_error(tables):
    with pytest.raises(KeyError):
        tables.rendered("<!-- results:nonsense -->\n<!-- /results -->", page(tables))


def test_rows_are_of_runs_that_there_are_and_as_long_as_their_head(tables):
    from measuring.plan import runs_of

    every = runs_of(BENCHMARKS)
    for name, table in tables.TABLES.items():
        for run, *cells in table.rows:
            assert run in every, name
            assert len(cells) == len(table.head), f"{name}: {cells}"


def test_each_table_stands_in_one_place_and_again_only_where_the_papers_are(tables):
    again = ("paper.md",)
    first = []
    for path in tables.documents():
        found = [match[1] for match in tables.REGION.finditer(path.read_text())]
        assert len(found) == len(set(found)), path
        assert set(found) <= {*tables.TABLES, tables.MACHINE}, path
        first += [] if path.name in again else found
    assert sorted(first) == sorted([*tables.TABLES, tables.MACHINE])


def test_the_tables_are_what_results_json_gives(tables):
    page = tables.open_page()
    stale = [
        p.name
        for p in tables.documents()
        if tables.rendered(p.read_text(), page) != p.read_text()
    ]
    assert not stale, (
        f"{', '.join(stale)}: not what benchmarks/results.json gives; run `make tables`"
    )


def test_the_peers_agree_between_the_benchmarks_that_measure_them(tables):
    runs = tables.open_page().runs
    if not all(
        runs.get(name, {}).get("result") for name in ("lidar_peers", "env_throughput")
    ):
        pytest.skip("benchmarks/results.json has no run of both")
    lidar, steps = (runs[name]["result"] for name in ("lidar_peers", "env_throughput"))
    for name in lidar["peer_readings"]:
        alone = lidar["peer_readings"][name]["scan_s"]
        within = steps["peer_readings"][name]["scan_within_step_s"]
        assert within == pytest.approx(alone, rel=0.20), name
