"""What a reader says of what it left out."""

from __future__ import annotations

import logging

from sightline.tally import LeftOut, Tally


def test_counts_by_reason_and_shows_the_first_place_of_each(caplog):
    tally = Tally("boat.nmea", "NMEA 0183")
    tally.count("sentences", 5)
    tally.count("sentences")
    tally.leave_out("with a wrong checksum", row="line 3", text="$GPRMC,1\x1b[2J\r\n")
    tally.leave_out("with a wrong checksum", 2, row="line 4", text="$GPRMC,2")
    tally.leave_out("without a place", 0, row="line 9")
    tally.note("Its times are taken as UTC.")
    tally.note("Its times are taken as UTC.")
    assert tally.read == {"sentences": 6}
    replaced = "\N{REPLACEMENT CHARACTER}"
    assert tally.left_out == {
        "with a wrong checksum": LeftOut(3, "line 3", f"$GPRMC,1{replaced}[2J{replaced}{replaced}")
    }
    assert tally.total_left_out == 3
    with caplog.at_level(logging.WARNING):
        tally.warn(logging.getLogger("sightline"))
    first, second = caplog.messages
    assert first.startswith("boat.nmea: left out: 3 with a wrong checksum (line 3: $GPRMC,1")
    assert second == "boat.nmea: Its times are taken as UTC."


def test_says_nothing_where_all_was_read(caplog):
    tally = Tally("boat.nmea")
    tally.count("fixes", 200)
    with caplog.at_level(logging.WARNING):
        tally.warn(logging.getLogger("sightline"))
    assert not caplog.messages
    assert tally.reasons() == ""


def test_a_long_text_is_shortened():
    tally = Tally("x")
    tally.leave_out("unreadable", text="a" * 500)
    assert len(tally.left_out["unreadable"].text) == 60
