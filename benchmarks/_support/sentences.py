"""NMEA 0183 sentences with their checksums, as the tests write them."""

from __future__ import annotations

from datetime import UTC, datetime
from functools import reduce
from operator import xor

import numpy as np
import pyais

NOON_S = 1_601_467_200.0  # 2020-09-30T12:00:00Z
LATITUDE_DEG, LONGITUDE_DEG = 54.3233, 10.1394
MMSI = 211_999_001


def sentence(body: str, start: str = "$") -> str:
    return f"{start}{body}*{reduce(xor, body.encode()):02X}"


def moment(second: float, form: str) -> str:
    return datetime.fromtimestamp(NOON_S + second, UTC).strftime(form)


def clock(second: float) -> str:
    return f"{moment(second, '%H%M')}{(NOON_S + second) % 60.0:05.2f}"


def north_deg(second: float) -> float:
    """Where the vessel is: it goes north at some 3 m/s."""
    return LATITUDE_DEG + second * 2.7e-5


def degrees_minutes(degrees: float, digits: int) -> str:
    whole, minutes = divmod(abs(degrees) * 60.0, 60.0)
    return f"{int(whole):0{digits}d}{minutes:010.7f}"


def place(second: float) -> str:
    latitude = degrees_minutes(north_deg(second), 2)
    return f"{latitude},N,{degrees_minutes(LONGITUDE_DEG, 3)},E"


def rmc(second: float, *, talker: str = "GP", status: str = "A", mode: str = "A") -> str:
    date = moment(second, "%d%m%y")
    return sentence(f"{talker}RMC,{clock(second)},{status},{place(second)},6.0,0.0,{date},,,{mode}")


def undated_rmc(second: float) -> str:
    return sentence(f"GPRMC,{clock(second)},A,{place(second)},6.0,0.0,,,,A")


def gga(second: float, *, talker: str = "GP", quality: int = 1) -> str:
    return sentence(f"{talker}GGA,{clock(second)},{place(second)},{quality},09,0.9,2.0,M,40.0,M,,")


def gll(second: float, *, status: str = "A,A") -> str:
    return sentence(f"GPGLL,{place(second)},{clock(second)},{status}")


def gns(second: float, *, modes: str = "AAN") -> str:
    return sentence(f"GNGNS,{clock(second)},{place(second)},{modes},09,0.9,2.0,40.0,,")


def zda(second: float, *, talker: str = "GP", zone: str = "00,00") -> str:
    return sentence(f"{talker}ZDA,{clock(second)},{moment(second, '%d,%m,%Y')},{zone}")


def hdt(heading_deg: float, *, talker: str = "HE") -> str:
    return sentence(f"{talker}HDT,{heading_deg:.2f},T")


def ths(heading_deg: float, mode: str = "A") -> str:
    return sentence(f"HETHS,{heading_deg:.2f},{mode}")


def payload(kind: int, second: float, /, **fields: float | str) -> str:
    """What a position report says, six bits a character."""
    content = {
        "type": kind,
        "mmsi": MMSI,
        "lat": north_deg(second),
        "lon": LONGITUDE_DEG,
        "speed": 5.8,
        "course": 0.0,
        "second": int(NOON_S + second) % 60,
        **fields,
    }
    return "".join(text.split(",")[5] for text in pyais.encode_dict(content, talker_id="AI"))


def vdm(body: str, *, talker: str = "AI", part: str = "1,1,", channel: str = "A") -> str:
    return sentence(f"{talker}VDM,{part},{channel},{body},0", "!")


def received(second: float, text: str) -> str:
    return f"\\s:rx,c:{NOON_S + second:.0f}*00\\{text}"


def off_m(latitude_deg: np.ndarray, time_utc_s: np.ndarray) -> np.ndarray:
    """(N,) metres by which latitudes miss where the vessel was."""
    wanted = [north_deg(second) for second in np.asarray(time_utc_s) - NOON_S]
    return np.abs(np.asarray(latitude_deg) - wanted) * 111_320.0
