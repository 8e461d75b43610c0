"""`warp-deform franka capture-goal`: the cable as it lies now becomes a goal."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from warp_deform.command.main import Outcome
from warp_deform.errors import InputError

from .rig_options import RigOptions, operator_page

if TYPE_CHECKING:
    import numpy as np

    from ..page.operator import PageOperator
    from ..rig.rig import Rig

__all__ = ["CaptureGoalOptions", "capture_goal"]


@dataclass(frozen=True, kw_only=True)
class CaptureGoalOptions(RigOptions):
    """Write the mask of the cable as it lies now, as a goal.

    With --camera sim the simulated chain is laid along a curve first. With --page you see picture
    and mask before they are written.
    """

    out: Annotated[Path, arg(metavar="FILE.png")]
    """File for the mask. The camera's picture is written beside it."""


def capture_goal(options: CaptureGoalOptions) -> Outcome:
    """Take a picture from where the arm stands, and write the cable's mask."""
    import numpy as np

    from ..episodes.goals import sampled_goal, write_goal
    from ..rig.rig import open_rig

    about = {"verb": "capture-goal", "agent": ""}
    with operator_page(options, about) as page, open_rig(options) as rig:
        if rig.lay is not None:
            targets = sampled_goal(options.seed, rig.view).targets
            assert targets is not None
            z = float(rig.calibration.table.height_m) + 0.003
            rig.lay(np.column_stack([targets, np.full(len(targets), z)]))
        mask, view = _seen(rig) if page is None or options.auto else _chosen(rig, page)
        if not mask.any():
            raise InputError(_NO_CABLE)
        beside = write_goal(options.out, mask, view)
        data = {"goal": options.out, "view": beside, "pixels": int(np.count_nonzero(mask))}
        text = f"{data['pixels']} px of cable: {options.out}, {beside}"
        if page is not None:
            page.over(text)
    return Outcome(data=data, text=text)


_NO_CABLE = "no cable is seen; lay it into the workspace, under even light"


def _seen(rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """The cable's mask, and the view from above."""
    from ..vision.segmentation import segment_cable

    view = rig.view.rectify(rig.camera.read().rgb, rig.calibration)
    return segment_cable(view, empty=rig.empty), view


def _chosen(rig: Rig, page: PageOperator) -> tuple[np.ndarray, np.ndarray]:
    """The same of the picture that the operator keeps.

    Raises:
        InputError: the operator stops
    """
    from ..cameras.camera import CameraError
    from ..episodes.episode import Observation
    from ..episodes.operators import Answer
    from ..vision.overlay import draw_action
    from ..vision.segmentation import SegmentationError, segment_cable

    while True:
        try:
            frame = rig.camera.read()
            view = rig.view.rectify(frame.rgb, rig.calibration)
            mask = segment_cable(view, empty=rig.empty)
        except (CameraError, SegmentationError) as problem:
            if not page.go_on(problem):
                raise
            continue
        page.look(
            frame,
            Observation(0, view, mask, None, None),
            draw_action(view, rig.view, mask=mask),
        )
        if not mask.any():
            answer = Answer.SKIP if page.go_on(InputError(_NO_CABLE)) else Answer.STOP
        else:
            answer = page.keep("is this mask to be the goal?")
        if answer is Answer.DO:
            return mask, view
        if answer is Answer.STOP:
            raise InputError("stopped at the page; nothing was written")
