"""What people count cameras for: crossings of lines, stays in zones, journeys, near misses."""

from sightline.counting.count import CountReport, CountSettings, Flow, count

__all__ = ["CountReport", "CountSettings", "Flow", "count"]
