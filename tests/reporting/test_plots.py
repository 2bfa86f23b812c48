from __future__ import annotations

import base64
from pathlib import Path
from xml.etree import ElementTree

import cv2
import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure

from sightline.errors import InputError
from sightline.evaluation.metrics import ScoredPairs, covered
from sightline.reporting.plots import (
    MapPanel,
    calibration,
    data_uri,
    error_against_range,
    error_over_time,
    image_residuals,
    map_figure,
    save_figure,
)

START = 1_601_494_584.0


def pairs_along_a_line(times=None, *, stated: bool = True) -> ScoredPairs:
    times = START + np.arange(20.0) if times is None else np.asarray(times)
    n = times.size
    rng = np.random.default_rng(0)
    true = np.column_stack([np.linspace(-40.0, 60.0, n), np.full(n, 90.0)])
    estimate = true + rng.normal(0.0, 3.0, (n, 2))
    return ScoredPairs(
        time_utc_s=times,
        east_m=estimate[:, 0],
        north_m=estimate[:, 1],
        covariance_m2=np.tile(
            np.diag([4.0, 9.0]) if stated else np.full((2, 2), np.nan), (n, 1, 1)
        ),
        true_east_m=true[:, 0],
        true_north_m=true[:, 1],
        segment=np.zeros(n, np.int64),
        asked=n,
    )


def picture_of(figure: Figure) -> np.ndarray:
    scheme, _, code = data_uri(figure, dpi=50).partition(",")
    assert scheme == "data:image/png;base64"
    image = cv2.imdecode(np.frombuffer(base64.b64decode(code), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image


def test_the_map_draws_the_log_and_the_ellipses_where_they_are() -> None:
    pairs = pairs_along_a_line()
    axes = map_figure([MapPanel("camera", pairs)]).axes[0]
    assert axes.get_title(loc="left") == "camera"
    assert axes.get_aspect() == 1.0
    paths = [
        segment
        for collection in axes.collections
        if isinstance(collection, LineCollection)
        for segment in collection.get_segments()
    ]
    truth = np.column_stack([pairs.true_east_m, pairs.true_north_m])
    assert any(path.shape == truth.shape and np.allclose(path, truth) for path in paths)
    (shapes,) = [c for c in axes.collections if isinstance(c, EllipseCollection)]
    np.testing.assert_allclose(shapes.get_offsets(), np.column_stack([pairs.east_m, pairs.north_m]))
    # The 95 % ellipse of standard deviations 2 m east and 3 m north, as full axes.
    np.testing.assert_allclose(shapes.get_widths(), 2.0 * 3.0 * 2.4477, rtol=1e-4)
    np.testing.assert_allclose(shapes.get_heights(), 2.0 * 2.0 * 2.4477, rtol=1e-4)
    low, high = axes.get_xlim()
    assert low < pairs.east_m.min()
    assert high > pairs.east_m.max()


def test_the_log_is_not_drawn_across_a_gap() -> None:
    times = START + np.r_[np.arange(10.0), 60.0 + np.arange(10.0)]
    axes = map_figure([MapPanel("track", pairs_along_a_line(times), smooth=True)]).axes[0]
    lengths = [
        len(segment)
        for collection in axes.collections
        if isinstance(collection, LineCollection)
        for segment in collection.get_segments()
    ]
    assert lengths == [10, 10, 10, 10]


def test_the_map_is_not_stretched_by_one_absurd_estimate() -> None:
    pairs = pairs_along_a_line()
    east = pairs.east_m.copy()
    east[3] = 1e6
    off = ScoredPairs(
        pairs.time_utc_s,
        east,
        pairs.north_m,
        pairs.covariance_m2,
        pairs.true_east_m,
        pairs.true_north_m,
        pairs.segment,
        asked=20,
    )
    axes = map_figure([MapPanel("qkr", off)]).axes[0]
    assert axes.get_xlim()[1] < 200.0


def test_several_panels_share_their_scale() -> None:
    panels = [MapPanel(str(k), pairs_along_a_line()) for k in range(5)]
    figure = map_figure(panels)
    shown = [axes for axes in figure.axes if axes.axison]
    assert len(shown) == 5
    assert len({axes.get_xlim() for axes in shown}) == 1
    assert picture_of(figure).std() > 5.0


def test_the_calibration_curve_is_the_coverage() -> None:
    pairs = pairs_along_a_line()
    axes = calibration({"camera": pairs, "none": pairs_along_a_line(stated=False)}).axes[0]
    labels = [line.get_label() for line in axes.lines]
    assert [label for label in labels if not label.startswith("_")] == ["camera (n = 20)"]
    curve = axes.lines[labels.index("camera (n = 20)")]
    np.testing.assert_allclose(curve.get_ydata(), covered(pairs, curve.get_xdata()))


def test_the_error_against_range_is_drawn_for_each_pair() -> None:
    pairs = pairs_along_a_line()
    axes = error_against_range({"camera": pairs}).axes[0]
    np.testing.assert_allclose(axes.lines[0].get_xdata(), pairs.true_range_m)
    np.testing.assert_allclose(axes.lines[0].get_ydata(), np.maximum(pairs.error_m, 0.1))


def test_recordings_without_pairs_have_no_panel_over_time() -> None:
    figure = error_over_time({"07": pairs_along_a_line(), "06": ScoredPairs.concatenate([])})
    assert [axes.get_title(loc="left") for axes in figure.axes if axes.axison] == ["07"]
    assert picture_of(error_over_time({})).size > 0


def test_the_stated_band_is_that_along_the_line_of_sight() -> None:
    # A target due north: the band's half width is 1.96 times the standard deviation north, 3 m.
    n = 5
    pairs = ScoredPairs(
        time_utc_s=START + np.arange(n),
        east_m=np.zeros(n),
        north_m=np.full(n, 50.0),
        covariance_m2=np.tile(np.diag([4.0, 9.0]), (n, 1, 1)),
        true_east_m=np.zeros(n),
        true_north_m=np.full(n, 50.0),
        segment=np.zeros(n, np.int64),
        asked=n,
    )
    axes = error_over_time({"07": pairs}).axes[0]
    (band,) = axes.collections
    corners = band.get_paths()[0].vertices
    assert corners[:, 1].max() == pytest.approx(1.95996 * 3.0, rel=1e-5)
    assert corners[:, 1].min() == pytest.approx(-1.95996 * 3.0, rel=1e-5)


def test_residuals_are_drawn_in_the_image() -> None:
    pixel = np.array([[100.0, 400.0], [900.0, 500.0], [600.0, 450.0]])
    residual = np.array([[0.0, 2.0], [1.0, 0.0], [30.0, 30.0]])
    figure = image_residuals(pixel, residual, (1280, 720), outlier=[False, False, True])
    axes = figure.axes[0]
    assert axes.get_xlim() == (0.0, 1280.0)
    assert axes.get_ylim() == (720.0, 0.0)
    np.testing.assert_allclose(axes.collections[0].get_offsets(), pixel[:2])
    np.testing.assert_allclose(axes.collections[1].get_offsets(), pixel[2:])
    drawn = np.column_stack([axes.collections[0].U, axes.collections[0].V])
    # Magnified so that the median, 2 px, is at most 3 % of the width: 10 times.
    np.testing.assert_allclose(drawn, 10.0 * residual[:2])
    with pytest.raises(InputError, match="3 pixels need as many residuals, not 2"):
        image_residuals(pixel, residual[:2], (1280, 720))


def test_a_figure_is_written_in_the_format_of_its_ending(tmp_path) -> None:
    figure = calibration({"camera": pairs_along_a_line()})
    for name, start in (("a.png", b"\x89PNG"), ("a.svg", b"<?xml"), ("a.PDF", b"%PDF")):
        save_figure(figure, tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(start)
    with pytest.raises(InputError, match=r"ends in .png, .svg, .pdf"):
        save_figure(figure, tmp_path / "a.jpg")
    assert len(list(tmp_path.iterdir())) == 3


def test_a_map_of_nothing_is_refused() -> None:
    with pytest.raises(InputError, match="at least one panel"):
        map_figure([])


def test_plots_leave_the_settings_and_figures_of_the_caller_alone() -> None:
    settings = dict(matplotlib.rcParams)
    before = pyplot.get_fignums()
    map_figure([MapPanel("camera", pairs_along_a_line())])
    assert pyplot.get_fignums() == before
    assert dict(matplotlib.rcParams) == settings


HOSTILE = (
    "berth$^$07",
    "$\\frac{1}$ $",
    r"\input{/etc/hostname} $\write18{x}$",
    "<script>]]>&amp;--></svg>",
    "\x1b[31m\0\x07",
    "a\ud800b\uffff",
    "two\nlines\r\nand\ttabs",
    "x" * 5000,
    "",
)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_name_is_text_in_every_figure(name: str, tmp_path: Path) -> None:
    """Between dollar signs Matplotlib reads formulas, and TeX reads what it is told to."""
    pairs = pairs_along_a_line()
    figures = [
        map_figure([MapPanel(name, pairs)]),
        error_against_range({name: pairs}),
        calibration({name: pairs}),
        error_over_time({name: pairs}),
    ]
    for i, figure in enumerate(figures):
        path = tmp_path / f"{i}.svg"
        save_figure(figure, path)
        ElementTree.parse(path)
        assert picture_of(figure).shape[2] == 3


def test_a_name_with_dollars_is_shown_with_them() -> None:
    figure = map_figure([MapPanel("a$b$c", pairs_along_a_line())])
    title = figure.axes[0]._left_title  # type: ignore[attr-defined]
    assert (title.get_text(), title.get_parse_math(), title.get_usetex()) == ("a$b$c", False, False)
    for figure in (
        calibration({"$x$": pairs_along_a_line()}),
        error_against_range({"$x$": pairs_along_a_line()}),
    ):
        legend = figure.axes[0].get_legend()
        assert legend is not None
        assert ["$x$" in text.get_text() for text in legend.get_texts()] == [True]
        assert not any(text.get_parse_math() for text in legend.get_texts())
