"""A synthetic harbour whose truth is known: as numbers, as pictures, and as files."""

from sightline.simulation.camera import SimulatedCamera
from sightline.simulation.harbour import (
    EXACT,
    BoxNoise,
    Harbour,
    HarbourSettings,
    ReceiverNoise,
    Truth,
)
from sightline.simulation.platform import Knock
from sightline.simulation.render import Look, Renderer
from sightline.simulation.several import SeveralSettings, harbours
from sightline.simulation.simulate import (
    Recording,
    Simulation,
    SimulationSettings,
    simulate,
)

__all__ = [
    "EXACT",
    "BoxNoise",
    "Harbour",
    "HarbourSettings",
    "Knock",
    "Look",
    "ReceiverNoise",
    "Recording",
    "Renderer",
    "SeveralSettings",
    "SimulatedCamera",
    "Simulation",
    "SimulationSettings",
    "Truth",
    "harbours",
    "simulate",
]
