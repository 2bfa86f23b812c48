"""Whose log is it: boxes of anything and logs in, pairs of a box and a place out."""

from sightline.association.associate import Association, Found, associate
from sightline.association.teach import associate_scene, fit_association, fit_scene, update_scene

__all__ = [
    "Association",
    "Found",
    "associate",
    "associate_scene",
    "fit_association",
    "fit_scene",
    "update_scene",
]
