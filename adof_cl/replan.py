"""Plans for the loop, made anew as the scene changes: far, coarse and cheap; near, fine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from adof_cl.device import Device
from adof_cl.errors import BudgetError, InputError
from adof_cl.optics import Mask, OpticalSystem
from adof_cl.pipeline import WindowedPipeline
from adof_cl.planner import Plan, Planner
from adof_cl.profile import TEMPLATE_PX, WINDOWS, Chain
from adof_cl.scene import Scene, SceneObject

_PLACE_SIGMA_PX = 2.5  # of a part whose stage moves while it is looked at
_DEPTH_SIGMA_UM = 5.0  # of autofocus, and of depth from two frames; where that is worse, it is stated
_SEARCHES_PX = (48, 64)


@dataclass(frozen=True)
class Budget:
    """What a run may cost: one of the two.

    Attributes
    ----------
    max_error_um
        Of a feature's place when docking; one per cent of the depth that is left, where that is more.
    max_ms
        Of compute a pair of frames.
    """

    planner: Planner
    max_error_um: float | None = None
    max_ms: float | None = None

    def __post_init__(self) -> None:
        if (self.max_error_um is None) == (self.max_ms is None):
            raise InputError("a budget is max_error_um or max_ms: give one, the other follows")


class Replanner:
    """One camera's plans during a run, and the pipeline that carries them out.

    Built once: compiles and allocates every window that a plan may choose. `choose` computes and switches,
    and makes nothing on the device.

    Parameters
    ----------
    parts
        Names of what is followed.
    cameras
        Among how many the compute of `Budget.max_ms` is shared.
    """

    def __init__(
        self,
        device: Device,
        optics: OpticalSystem,
        shape: tuple[int, int],
        parts: Sequence[str],
        budget: Budget,
        *,
        frame_rate_hz: float,
        cameras: int = 2,
    ) -> None:
        self._planner, self._budget = budget.planner, budget
        self._optics, self._shape = optics, shape
        self._frame_rate_hz, self._cameras = frame_rate_hz, cameras
        kinds = ("half", "float32")
        usual = Chain("half", 192, "gauss_newton", TEMPLATE_PX, _SEARCHES_PX[0])
        self._restoration = min(
            kinds, key=lambda kind: self._planner.predict_s(replace(usual, restoration=kind), 2)
        )
        sides = [side for side in WINDOWS if side <= min(shape)]
        chains = [
            replace(usual, restoration=self._restoration, window_px=side, search_px=search)
            for search in _SEARCHES_PX[::-1]
            for side in sides
            if not side or side > search
        ]
        windows = [chain.window(shape) for chain in chains]
        nsr = self._planner.profile.nsr
        self.pipeline = WindowedPipeline(device, optics, shape, dict.fromkeys(parts, windows), nsr=nsr)
        self.unrestored: frozenset[str] = frozenset()
        self._known: dict[bool, _Known] = {}
        self._safe = replace(usual, restoration=self._restoration, window_px=0, search_px=_SEARCHES_PX[-1])

    def scene(
        self,
        depth_um: Mapping[str, float],
        extent_px: Mapping[str, float],
        speed_um_per_s: float,
        depth_sigma_um: float = 0.0,
    ) -> Scene:
        """Return what is to be seen: parts at depths, known to so much or worse, of which the last moves."""
        names = list(depth_um)
        objects = tuple(
            SceneObject(
                name,
                depth_um[name],
                depth_sigma_um=max(_DEPTH_SIGMA_UM, depth_sigma_um),
                extent_px=extent_px[name],
                place_sigma_px=_PLACE_SIGMA_PX,
                speed_um_per_s=speed_um_per_s if name == names[-1] else 0.0,
            )
            for name in names
        )
        return Scene(objects, frame_rate_hz=self._frame_rate_hz, shape=self._shape, optics=self._optics)

    def plan(self, scene: Scene, left_um: float, mask: Mask | None = None) -> Plan | None:
        """Return the plan for what is left to go, the nearest possible one, or None where there is none.

        While depths have hardly changed, and the mask not at all, the last plan is returned again.
        """
        depths = tuple(thing.depth_um for thing in scene.objects)
        sigma_um = max(thing.depth_sigma_um for thing in scene.objects)
        known = self._known.get(mask is None)
        if (
            known is not None
            and mask in (None, known.mask)
            and _alike(depths, known.depths_um)
            and sigma_um <= 1.5 * known.sigma_um
        ):
            return known.plan
        budget = self._budget
        plan: Plan | None
        try:
            if budget.max_ms is not None:
                most_ms = budget.max_ms / self._cameras
                plan = self._planner.plan(scene, max_ms=most_ms, mask=mask, explain=False)
            else:
                assert budget.max_error_um is not None
                most_um = max(budget.max_error_um, 0.01 * left_um)
                plan = self._planner.plan(scene, max_error_um=most_um, mask=mask, explain=False)
        except BudgetError as refusal:
            plan = refusal.nearest if isinstance(refusal.nearest, Plan) else None
        self._known[mask is None] = _Known(depths, sigma_um, mask, plan)
        return plan

    def choose(self, plan: Plan | None) -> None:
        """Follow every part as planned from the next frame on; without a plan, as carefully as can be."""
        plans = {} if plan is None else {thing.name: thing for thing in plan.objects}
        for part in self.pipeline.parts:
            chain, tolerance = self._safe, None
            if part in plans:
                chain, tolerance = plans[part].chain, plans[part].tolerance_rad
            window = replace(chain, restoration=self._restoration).window(self._shape)
            self.pipeline.use(part, window if tolerance is None else replace(window, tolerance_rad=tolerance))
        self.unrestored = frozenset(n for n, thing in plans.items() if thing.chain.restoration == "none")


@dataclass(frozen=True)
class _Known:
    """The last plan, and what it was for."""

    depths_um: tuple[float, ...]
    sigma_um: float
    mask: Mask | None
    plan: Plan | None


def _alike(depths_um: Sequence[float], others_um: Sequence[float]) -> bool:
    """Whether no depth moved by more than the scene's own uncertainty, or one per cent."""
    return all(
        abs(a - b) <= max(_DEPTH_SIGMA_UM, 0.01 * abs(b)) for a, b in zip(depths_um, others_um, strict=True)
    )
