"""The picture of an efficiency fit: no text lies on another one or beyond the picture."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from jtqd.sysid.fit.efficiency import fit_efficiency
from jtqd.sysid.fit.plateaus import Mean
from tests.sysid.fit.eta_grid import JOINT, grid, plateau, points_of

pytest.importorskip("matplotlib")


@pytest.mark.parametrize("close", [False, True])
def test_texts_do_not_overlap(close: bool) -> None:
    """close: velocities so near each other that their numbers would not fit beside the bar."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    from jtqd.sysid.fit.efficiency import fit_figure

    points = grid(JOINT)
    if close:
        points += [replace(each, velocity=Mean(1.04 * each.velocity.value, 1e-4)) for each in points]
    points = [each for each in points if abs(each.current.value) > 1.5] + [plateau(5.05, 3.0, 30.0)]
    found = points_of(points)
    fit = fit_efficiency(found, "joint_over_motor", JOINT)
    figure = fit_figure(found, fit, "joint1: measured efficiency and Eq. (8), convention joint_over_motor")
    figure.draw_without_rendering()
    beyond = {
        label
        for axes in figure.axes
        for axis in (axes.xaxis, axes.yaxis)
        for tick in axis.get_major_ticks()
        for label in (tick.label1, tick.label2)
        if not min(axis.get_view_interval()) <= tick.get_loc() <= max(axis.get_view_interval())
    }
    texts = [
        text
        for text in figure.findobj(mpl.text.Text)
        if text.get_visible() and text.get_text().strip() and text not in beyond
    ]
    boxes = [(text.get_text(), text.get_window_extent()) for text in texts]
    panels = [axes for axes in figure.axes if "plateaus" in axes.get_title(loc="left")]
    edges = {axes.get_title(loc="left"): axes.get_window_extent().x1 for axes in panels}
    plt.close(figure)
    assert len(edges) == 4
    assert all(box.x1 <= edges.get(text, box.x1) for text, box in boxes), "a title beyond its panel"
    width, height = figure.get_size_inches() * figure.dpi
    for text, box in boxes:
        assert -1 <= box.x0 <= box.x1 <= width + 1, text
        assert -1 <= box.y0 <= box.y1 <= height + 1, text
    for (one, a), (other, b) in itertools.combinations(boxes, 2):
        assert not a.shrunk(0.9, 0.9).overlaps(b.shrunk(0.9, 0.9)), (one, other)
