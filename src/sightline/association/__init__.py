"""Association of boxes with logged vessels, for a fit without drawn boxes."""

from sightline.association.associate import Association, Found, associate

__all__ = ["Association", "Found", "associate"]
