"""What a frame costs the shipped detector, and what that makes of some boards.

    python benchmarks/small_boards.py [--detector FILE.onnx] [--json FILE]

Counts the multiplications of all convolutions and matrix products, and the bytes of weights and of
what goes in and out of them, for the views of a simulated frame of 1280 x 720 px. Measures how long
the frame takes on one thread here. For boards the time is **computed** and not measured: the larger
of operations by a tenth to a half of the peak, and of bytes by bandwidth (Williams et al.,
Roofline, 2009). Peaks are those of the data sheets: clock x units x lanes x 2.
"""

from __future__ import annotations

import argparse
import json
import time
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from onnx import numpy_helper, shape_inference
from rich.console import Console
from rich.table import Table

from sightline.detection import DetectorOptions, OnnxDetector
from sightline.detection.registry import shipped_file
from sightline.simulation import Harbour, HarbourSettings, Renderer
from sightline.types import Frame

RUNS = 60
SHARES = (0.1, 0.5)
"""Of the peak that networks of small convolutions reach, from poor to good."""


@dataclass(frozen=True)
class Board:
    """What a data sheet says.

    Attributes:
        name: Of the board, and what of it computes.
        gflops: Peak in single precision of all cores, or of the GPU.
        gb_s: Bandwidth of its memory.
    """

    name: str
    gflops: float
    gb_s: float


BOARDS = (
    # Four Cortex-A57 at 2.0 GHz, one unit of four lanes; the two Denver cores are left out.
    Board("Jetson TX2, 4 cores", 4 * 2.0 * 4 * 2, 59.7),
    # 256 lanes at 1.3 GHz.
    Board("Jetson TX2, GPU", 256 * 1.3 * 2, 59.7),
    # Four Cortex-A76 at 2.4 GHz, two units of four lanes.
    Board("Raspberry Pi 5, 4 cores", 4 * 2.4 * 8 * 2, 17.1),
    # Six Cortex-A78AE at 1.5 GHz, two units of four lanes.
    Board("Jetson Orin Nano 8 GB, 6 cores", 6 * 1.5 * 8 * 2, 68.0),
    # 1024 lanes at 625 MHz.
    Board("Jetson Orin Nano 8 GB, GPU", 1024 * 0.625 * 2, 68.0),
)


def cost(path: Path, sizes: list[tuple[int, int]]) -> tuple[float, float]:
    """Multiplications and bytes of a network for pictures of these widths and heights."""
    macs = moved = 0.0
    for width, height in sizes:
        model = onnx.load(str(path))
        for dim, value in zip(
            model.graph.input[0].type.tensor_type.shape.dim, (1, 3, height, width), strict=True
        ):
            dim.dim_value = value
        del model.graph.value_info[:]
        inferred = shape_inference.infer_shapes(model, data_prop=True)
        shapes = {
            one.name: [d.dim_value for d in one.type.tensor_type.shape.dim]
            for one in (*inferred.graph.value_info, *inferred.graph.input, *inferred.graph.output)
        }
        weights = {one.name: numpy_helper.to_array(one) for one in model.graph.initializer}
        for node in inferred.graph.node:
            if node.op_type not in ("Conv", "MatMul") or node.input[1] not in weights:
                continue
            kernel, out = weights[node.input[1]], shapes[node.output[0]]
            each = kernel[0].size if node.op_type == "Conv" else kernel.shape[0]
            macs += float(np.prod(out)) * each
            moved += 4.0 * (np.prod(out) + np.prod(shapes[node.input[0]]) + kernel.size)
    return macs, moved


def seconds(detector: OnnxDetector, frame: Frame) -> float:
    """The least time of a frame that lies in memory."""
    times = []
    for _ in range(RUNS):
        begun_s = time.perf_counter()
        detector.detect(frame)
        times.append(time.perf_counter() - begun_s)
    return min(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--detector", type=Path, help="an ONNX file in single precision")
    parser.add_argument("--json", type=Path, metavar="FILE")
    arguments = parser.parse_args()
    harbour = Harbour.random(3, HarbourSettings(duration_s=10.0))
    frame = Frame(0, 0.0, Renderer(harbour).image(harbour.start_utc_s))
    with nullcontext(arguments.detector) if arguments.detector else shipped_file() as path:
        detector = OnnxDetector(path, options=DetectorOptions(threads=1))
        sizes = [one["images"].shape[:1:-1] for one in detector.inputs(frame)]
        macs, moved = cost(path, sizes)
        here_s = seconds(detector, frame)
    shown = " and ".join(f"{width} x {height}" for width, height in sizes)
    print(f"a frame of 1280 x 720 px is shown to the network as {shown} px")
    print(f"{macs / 1e9:.2f} thousand million multiplications, {moved / 1e6:.0f} MB moved")
    print(
        f"measured here, one thread: {1e3 * here_s:.1f} ms a frame, "
        f"{2e-9 * macs / here_s:.0f} GFLOPS"
    )
    table = Table("computed for", "GFLOPS", "GB/s", "ms a frame", "frames a second")
    computed = {}
    for board in BOARDS:
        most, least = (
            max(2e-9 * macs / (board.gflops * share), 1e-9 * moved / board.gb_s) for share in SHARES
        )
        computed[board.name] = [1e3 * least, 1e3 * most]
        table.add_row(
            board.name,
            f"{board.gflops:.0f}",
            f"{board.gb_s:g}",
            f"{1e3 * least:.0f} to {1e3 * most:.0f}",
            f"{1.0 / most:.0f} to {1.0 / least:.0f}",
        )
    Console().print(table)
    if arguments.json:
        result: dict[str, object] = {
            "multiplications": macs,
            "bytes": moved,
            "here_ms": 1e3 * here_s,
        }
        result["computed_ms"] = computed
        arguments.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
