"""Tables of evaluations, in Markdown."""

from training.tables import heading, percent, table


def test_table_shows_what_a_row_has_and_a_dash_where_it_lacks():
    columns = (("name", "{name}"), ("both", "{first:.1f} ({second:.2f})"))
    rows = [{"name": "a", "first": 1.25, "second": 2.0}, {"name": "b", "first": 1.0}]
    assert table(columns, rows) == [
        "| name | both |",
        "|---|--:|",
        "| a | 1.2 (2.00) |",
        "| b | - |",
    ]


def test_heading_begins_with_the_command():
    lines = heading("the command", {"seed": 1, "windows": 20}, "A legend.")
    assert lines == ["`the command`", "", "seed 1, windows 20.", "", "A legend."]


def test_share_that_is_not_known_is_a_dash():
    assert percent(None) == "-"
    assert percent(0.254) == "25 %"
