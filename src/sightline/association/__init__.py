"""Whose log it is: boxes of anything and logs in, boxes with a vessel's place out."""

from sightline.association.associate import Association, Found, associate

__all__ = ["Association", "Found", "associate"]
