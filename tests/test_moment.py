"""The message of a moment, as the contract has it."""

import json

import numpy as np

from sightline.moment import Moment, TargetState


def test_the_message_of_a_moment_has_the_keys_and_the_numbers_of_the_contract():
    target = TargetState(
        id=17,
        latitude_deg=54.3,
        longitude_deg=10.1,
        covariance_m2=np.array([[4.0, 1.0], [1.0, 9.0]]),
        speed_mps=3.1,
        course_deg=210.5,
        state="measured",
        box_xyxy_px=(1.0, 2.0, 3.0, 4.06),
        confidence=0.9,
    )
    # 1 June 2024, 10:00:00 UTC by `date -u -d 2024-06-01T10:00:00Z +%s`.
    moment = Moment(1717236000.040, "sender", "harbour-office", (target,))
    assert json.loads(moment.text) == {
        "time_utc": "2024-06-01T10:00:00.040Z",
        "capture": "sender",
        "camera": "harbour-office",
        "targets": [
            {
                "id": 17,
                "latitude_deg": 54.3,
                "longitude_deg": 10.1,
                "covariance_m2": [[4.0, 1.0], [1.0, 9.0]],
                "speed_mps": 3.1,
                "course_deg": 210.5,
                "state": "measured",
                "box_xyxy_px": [1.0, 2.0, 3.0, 4.1],
                "confidence": 0.9,
                "mmsi": None,
                "name": None,
                "match": None,
            }
        ],
    }
