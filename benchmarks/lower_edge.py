"""How low the boxes of detectors end below the waterline, on rendered boats.

    python benchmarks/lower_edge.py [--harbours 24] [--classes boat] [--write] [DETECTOR ...]

A DETECTOR is a name or an ONNX file; absent: the one that ships, and `detectors/fold2.onnx`, which
learned from other recordings. With `--write` what is measured is written into a file's metadata
(needs `onnx`), from where the fit without drawn boxes takes it.
"""

from __future__ import annotations

import argparse
import itertools
import json
from pathlib import Path

import numpy as np
from _support.lower_edge import lower_edge, overhang

from sightline.atomic import atomic_path
from sightline.detection import DEFAULT_DETECTOR, DetectorOptions, LowerEdge, detector_by_name
from sightline.detection.metadata import KEY

FOLD2 = Path(__file__).parent / "detectors" / "fold2.onnx"
HEIGHTS_PX = (4, 6, 10, 15, 25, 40, 80)


def write(path: str, edge: LowerEdge) -> None:
    """Put what was measured into the file."""
    import onnx  # only where a file is written

    model = onnx.load(path)
    for entry in model.metadata_props:
        if entry.key == KEY:
            known = json.loads(entry.value)
            entry.value = json.dumps(known | {"lower_edge": edge.model_dump()})
            break
    else:
        raise SystemExit(
            f"{path}: was not exported by sightline, so it has no metadata to write to"
        )
    with atomic_path(path) as temporary:
        onnx.save(model, str(temporary))


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("detectors", nargs="*", default=[DEFAULT_DETECTOR, str(FOLD2)])
    arguments.add_argument("--harbours", type=int, default=24)
    arguments.add_argument("--classes", help="absent: those that the file is for")
    arguments.add_argument("--write", action="store_true")
    given = arguments.parse_args()
    for name in given.detectors:
        classes = tuple(given.classes.split(",")) if given.classes else None
        options = DetectorOptions(classes=classes)
        seen = overhang(detector_by_name(name, options=options), given.harbours)
        edge = lower_edge(seen)
        print(
            f"{Path(name).name}: {len(seen)} boats; boxes end {edge.px:.2f} px and "
            f"{100 * edge.share:.1f} % of the height below the hull, "
            f"{edge.spread_px:.2f} px from harbour to harbour"
        )
        for low, high in itertools.pairwise(HEIGHTS_PX):
            own = (seen.height_px >= low) & (seen.height_px < high)
            if own.sum() >= 5:
                print(
                    f"  {low:2d} to {high:2d} px high: {own.sum():4d} boats, median "
                    f"{np.median(seen.below_px[own]):5.2f} px, by the line "
                    f"{edge.px + edge.share * seen.height_px[own].mean():5.2f} px"
                )
        if given.write:
            edge = LowerEdge(**{key: round(value, 3) for key, value in edge.model_dump().items()})
            write(name, edge)


if __name__ == "__main__":
    main()
