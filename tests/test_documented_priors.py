"""The priors that the documentation lists are those of the code."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

import pytest

from sightline.camera import mixed_model, stated, target_sizes
from sightline.camera.priors import NOISE_PRIORS, CameraPrior
from sightline.camera.stated_place import WRONG_PLACE_SHARE, WRONG_PLACE_SIGMA_M
from sightline.clock_offset import STATED_SIGMA_S, USUAL_SIGMA_S
from sightline.georeferencing.camera_regressor import UNSEEN_BIAS_PX

PAGE = Path(__file__).parents[1] / "docs" / "camera-model.md"
ROWS = re.findall(r"^\| (`.+`) \| (.+?) \| (.+?) \| .+ \|$", PAGE.read_text("utf-8"), re.MULTILINE)


def numbers_of_the_code() -> dict[str, tuple[float, ...]]:
    out: dict[str, tuple[float, ...]] = {
        "UNSEEN_BIAS_PX": (UNSEEN_BIAS_PX,),
        "USUAL_SIGMA_S": (USUAL_SIGMA_S,),
        "STATED_SIGMA_S": (STATED_SIGMA_S,),
        "WRONG_PLACE_SIGMA_M": (WRONG_PLACE_SIGMA_M,),
        "WRONG_PLACE_SHARE": (WRONG_PLACE_SHARE,),
    }
    for name in ("BEAM_SHARE", "USUAL_SPREAD", "_WIDTH_SIGMA"):
        out[name] = (getattr(target_sizes, name),)
    for name in ("_SIZE_SHARE", "_STATED_SIZE_SHARE", "_MIDDLE_SIGMA_M", "_MIDDLE_SHARE"):
        out[name] = (getattr(mixed_model, name),)
    for name in vars(stated):
        if name.startswith("STATED_") or name == "PICTURE_FOCAL_SHARE":
            out[name] = (getattr(stated, name),)
    for field in fields(CameraPrior):
        value = getattr(CameraPrior(), field.name)
        # Where nothing is believed there is no number.
        numbers = () if value is None else (value,)
        out[field.name] = value if isinstance(value, tuple) else numbers
    for name, prior in NOISE_PRIORS.items():
        out[name] = (prior.typical, prior.log_sigma) if prior.log_sigma else (prior.typical,)
    return out


def test_all_priors_are_listed_once() -> None:
    listed = [name for names, _, _ in ROWS for name in re.findall(r"`(\w+)`", names)]
    assert sorted(listed) == sorted(numbers_of_the_code())


@pytest.mark.parametrize(("names", "cell"), [(row[0], row[2]) for row in ROWS])
def test_numbers_of_a_prior_are_those_of_the_code(names: str, cell: str) -> None:
    code = numbers_of_the_code()
    expected = [value for name in re.findall(r"`(\w+)`", names) for value in code[name]]
    written = [float(number) for number in re.findall(r"[\d.]+", cell)]
    assert written == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("name", NOISE_PRIORS)
def test_form_of_a_noise_prior_is_that_of_the_code(name: str) -> None:
    prior = NOISE_PRIORS[name]
    (form,) = [form for names, form, _ in ROWS if names == f"`{name}`"]
    assert form.startswith("log-normal" if prior.log_sigma else "exponential")
    assert ("keeps off zero" in form) == prior.positive
