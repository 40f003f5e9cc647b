"""The cheapest way to see a scene precisely enough, on one device: chosen from its profile, with reasons.

A plan chooses the mask, and for each object its restoration, its window and how far its features are refined;
whether and how often camera 2 is asked for depth; how closely filters follow depth. Choices are independent
between objects once the mask is chosen, so that every mask's best is found exactly, and the best of those.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from adof_cl.errors import BudgetError, InputError
from adof_cl.mask import filter_quality
from adof_cl.optics import Mask, OpticalSystem, require_positive
from adof_cl.pipeline import SAME_RAD, Window
from adof_cl.profile import (
    REFERENCE,
    REFINES,
    RESTORATIONS,
    SEARCHES,
    TEMPLATE_PX,
    WINDOWS,
    Chain,
    DeviceProfile,
)
from adof_cl.scene import Scene, SceneObject

Array = NDArray[np.float64]

SHARES = (0.6, 0.45, 0.3)
"""Shares of the band, |psi|/(3 alpha), that a mask may leave to defocus: the strongest mask last."""

_SIGMAS = 2.0  # how many standard deviations of depth a mask covers, and a filter may be wrong by
_PLACE_SIGMAS = 3.0  # of place, that a search covers
_FILTER_SHARE = 0.1  # of the accuracy wanted, that a filter not formed anew may cost
_LOST_PX = 1e3  # a feature that is not found
_MOST_FRAMES = 64  # between two looks of camera 2
_EVERY = (1, 4, 16)  # where it is looking more often that the time is spent on
_MOST_TOLERANCE_RAD = 1.0
_OPTICS_ALIKE = 1.25  # blur in pixels within this factor of the profile's


@dataclass(frozen=True)
class ObjectPlan:
    """How one object is seen.

    Attributes
    ----------
    chain
        By camera 1.
    second, every
        By camera 2, every so many frames; None: not at all.
    tolerance_rad
        Its filter is formed anew when alpha or psi moved by more.
    time_s
        Per frame, camera 2's share included.
    error_um, wanted_um
        How far off a feature is in at most 5 % of frames, and may be.
    depth_error_um, depth_wanted_um
        The same of its depth, where it is measured.
    depth_margin_um
        How far its depth may be from what was stated before the mask no longer covers it.
    """

    name: str
    chain: Chain
    second: Chain | None
    every: int
    tolerance_rad: float
    time_s: float
    error_um: float
    wanted_um: float
    depth_error_um: float | None
    depth_wanted_um: float | None
    depth_margin_um: float

    @property
    def excess(self) -> float:
        """Error over what was wanted, the worse of place and depth; at most 1 meets the budget."""
        excess = self.error_um / self.wanted_um
        if self.depth_error_um is not None and self.depth_wanted_um is not None:
            excess = max(excess, self.depth_error_um / self.depth_wanted_um)
        return excess


@dataclass(frozen=True)
class Plan:
    """How a scene is seen, what that costs, and why.

    Attributes
    ----------
    time_s
        Predicted, per frame.
    reasons, left_out
        One sentence for each choice; one for each thing that is not done, and why that is safe.
    """

    mask: Mask
    objects: tuple[ObjectPlan, ...]
    time_s: float
    reasons: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    @property
    def error_um(self) -> float:
        """The largest of the objects' errors."""
        return max(thing.error_um for thing in self.objects)

    @property
    def excess(self) -> float:
        """The largest error over what was wanted of it."""
        return max(thing.excess for thing in self.objects)

    def windows(self, shape: tuple[int, int], camera: int = 1) -> dict[str, Window]:
        """Return what `WindowedPipeline` is told of a camera."""
        made = {}
        for thing in self.objects:
            chain = thing.chain if camera == 1 else thing.second
            if chain is not None:
                made[thing.name] = replace(chain.window(shape), tolerance_rad=thing.tolerance_rad)
        return made


class _Errors:
    """Errors of every kind of chain over a grid of masks and defocus, interpolated."""

    def __init__(self, profile: DeviceProfile) -> None:
        kinds = [(r, f) for r in RESTORATIONS for f in REFINES]
        rows = {(e.restoration, e.refine, e.alpha_rad, e.share): e for e in profile.errors}
        flat = sorted({e.share for e in profile.errors if e.alpha_rad == 0})
        alphas = sorted({e.alpha_rad for e in profile.errors if e.alpha_rad > 0})
        shares = sorted({e.share for e in profile.errors if e.alpha_rad > 0})
        if not flat or not alphas or not shares:
            raise InputError("the profile holds no errors to plan with: measure it anew with adof tradeoff")
        self.flat, self.shares = np.array(flat), np.array(shares)
        self.alphas = np.array(alphas)
        self._log_alphas = np.log(self.alphas)
        self.noises = np.array(profile.noises_grey)
        self.restored = [kind for kind in kinds if kind[0] != "none"]
        self.plain = [kind for kind in kinds if kind[0] == "none"]

        def table(
            kinds: Sequence[tuple[str, str]], alphas: Sequence[float], shares: Sequence[float]
        ) -> Array:
            values = np.full((len(self.noises), len(kinds), len(alphas), len(shares)), _LOST_PX)
            for k, a, s in product(range(len(kinds)), range(len(alphas)), range(len(shares))):
                entry = rows.get((*kinds[k], alphas[a], shares[s]))
                if entry is not None:
                    values[:, k, a, s] = np.minimum(entry.errors_px, _LOST_PX)
            # More noise never helps: where it seemed to, a few frames were lucky.
            return np.asarray(np.maximum.accumulate(values, axis=0))

        self._plain = table(self.plain, [0.0], flat)[:, :, 0]
        self._restored = table(self.restored, alphas, shares)
        # In focus an object was measured beside one that is far out. Where that one's blur lost it, an object
        # that is a little out, beside one no farther, is found: no better than at the next share.
        lost = (self._restored[0, :, :, 0] >= _LOST_PX).any(axis=0)
        self.focused_alpha_rad = float(self.alphas[~lost].max(initial=0.0))
        self._restored[:, :, lost, 0] = self._restored[:, :, lost, 1]

    def without_mask(self, psi_rad: float, noise_grey: float) -> Array:
        """Return the errors (px) of `plain` kinds at a defocus."""
        if psi_rad > self.flat[-1]:
            return np.full(len(self.plain), np.inf)
        i, w = _place(self.flat, psi_rad)
        values = (1 - w) * self._plain[:, :, i] + w * self._plain[:, :, i + 1]
        return self._at(values, noise_grey)

    def with_mask(self, alpha_rad: float, share: float, noise_grey: float) -> Array:
        """Return the errors (px) of `restored` kinds; infinite outside what was measured."""
        if share > self.shares[-1] * (1 + 1e-9) or not self.alphas[0] * 0.999 <= alpha_rad <= self.alphas[-1]:
            return np.full(len(self.restored), np.inf)
        i, w = _place(self._log_alphas, math.log(alpha_rad))
        j, v = _place(self.shares, share)
        g = self._restored
        values = (1 - w) * ((1 - v) * g[:, :, i, j] + v * g[:, :, i, j + 1])
        values = values + w * ((1 - v) * g[:, :, i + 1, j] + v * g[:, :, i + 1, j + 1])
        return self._at(values, noise_grey)

    def _at(self, values: Array, noise_grey: float) -> Array:
        """Return errors at a noise between those measured: their squares are linear in its square."""
        i, w = _place(self.noises**2, noise_grey**2)
        total = np.sqrt((1 - w) * values[i] ** 2 + w * values[i + 1] ** 2)
        return np.where(total > _LOST_PX / 50, np.inf, total)


def _place(grid: Array, value: float) -> tuple[int, float]:
    """Return the interval of a grid that holds a value, and where in it; ends are held."""
    i = min(max(int(np.searchsorted(grid, value)) - 1, 0), len(grid) - 2)
    share = (value - float(grid[i])) / float(grid[i + 1] - grid[i])
    return i, min(max(share, 0.0), 1.0)


class _Times:
    """Times of chains: a restoration in a window plus a search, each as measured."""

    def __init__(self, profile: DeviceProfile, pace: float) -> None:
        self.shared_s = pace * profile.shared_s
        measured = {(t.chain, t.features): pace * t.time_s.median for t in profile.times}
        base = REFERENCE
        self._base = pace * profile.reference_s
        self._restore = {
            (c.restoration, c.window_px): seconds
            for (c, features), seconds in measured.items()
            if features == 1 and c.refine == base.refine and c.search_px == base.search_px
        }
        self._search = {
            (c.refine, c.search_px, features): seconds
            for (c, features), seconds in measured.items()
            if c.restoration == base.restoration and c.window_px == base.window_px
        }
        self._known: dict[tuple[Chain, int, int], float] = {}
        self._pixels = profile.shape[0] * profile.shape[1]
        self._form = {(f.restoration, f.window_px): pace * f.time_s.median for f in profile.forms}

    def knows(self, restoration: str) -> bool:
        return (restoration, WINDOWS[0]) in self._restore

    def chain(self, chain: Chain, features: int, shape: tuple[int, int]) -> float:
        """Return the time of one object's chain, in frames of a shape, while its filter stands."""
        key = chain, features, 0 if chain.window_px else shape[0] * shape[1]
        if key not in self._known:
            self._known[key] = self._sum(*key)
        return self._known[key]

    def _window(
        self, times: Mapping[tuple[str, int], float], restoration: str, side: int, pixels: int
    ) -> float:
        """Return what depends on the window; frames of another size than the profile's by their pixels."""
        seconds = times.get((restoration, side), 0.0)
        if side or pixels == self._pixels:
            return seconds
        largest = max(side for side in WINDOWS)
        window = times.get((restoration, largest), 0.0)
        return max(window + (seconds - window) * (pixels - largest**2) / (self._pixels - largest**2), 0.0)

    def _sum(self, chain: Chain, features: int, pixels: int) -> float:
        ends = (SEARCHES[0], SEARCHES[-1])
        share = (chain.search_px - ends[0]) / (ends[1] - ends[0])
        low, high = (
            (1 - share) * self._search[chain.refine, ends[0], k]
            + share * self._search[chain.refine, ends[1], k]
            for k in (1, 4)
        )
        search = low + (high - low) * (features - 1) / 3
        restore = self._window(self._restore, chain.restoration, chain.window_px, pixels)
        return max(restore + search - self._base, 1e-6)

    def form(self, chain: Chain, shape: tuple[int, int]) -> float:
        """Return the time to form its filter anew."""
        return self._window(self._form, chain.restoration, chain.window_px, shape[0] * shape[1])


@dataclass(frozen=True)
class Choice:
    """One way to see one object under one mask: `excess` is the error over what was wanted."""

    chain: Chain
    second: Chain | None
    every: int
    time_s: float
    error_um: float
    depth_um: float | None
    excess: float


class Planner:
    """Plans scenes on the device of a profile.

    Built once from the profile; `plan` only computes: about a millisecond for two objects, nothing on the
    device.

    Parameters
    ----------
    profile
        The device's.
    pace
        How many times as long everything takes now (`adof_cl.pace.pace`).

    Raises
    ------
    InputError
        The profile lacks what plans are made of; a pace that is not positive.
    """

    def __init__(self, profile: DeviceProfile, pace: float = 1.0) -> None:
        require_positive(pace=pace)
        self.profile = profile
        self.pace = pace
        self._errors = _Errors(profile)
        self._times = _Times(profile, pace)

    def plan(
        self,
        scene: Scene,
        *,
        max_error_um: float | None = None,
        max_ms: float | None = None,
        mask: Mask | None = None,
        explain: bool = True,
    ) -> Plan:
        """Choose the cheapest plan precise enough, or the most precise one cheap enough.

        Parameters
        ----------
        max_error_um
            For every feature, unless its object states an accuracy for the scene's phase; the smaller counts.
        max_ms
            Compute per frame. With it, accuracies that are stated only say which object matters more.
        mask
            The mask the frame was taken through, where that is not to be chosen.
        explain
            Whether sentences are wanted: they take as long as the plan.

        Raises
        ------
        InputError
            Neither or both budgets, with no accuracy stated; an object that needs depth and no camera 2; more
            noise, or other optics, than errors were measured with.
        BudgetError
            No plan meets the budget: the nearest possible one is in the message and in `nearest`.
        """
        if max_error_um is not None and max_ms is not None:
            raise InputError("both max_error_um and max_ms came: give one, the other follows")
        for name, value in (("max_error_um", max_error_um), ("max_ms", max_ms)):
            if value is not None:
                require_positive(**{name: value})
        self._require_measured(scene)
        wanted = [self._wanted_um(scene, thing, max_error_um, max_ms) for thing in scene.objects]

        def explained(plan: Plan, others: Sequence[Plan]) -> Plan:
            return self._explained(scene, plan, others) if explain else plan

        candidates = []
        masks = [mask] if mask is not None else list(self.masks(scene))
        for each in masks:
            options = [
                self.choices(scene, each, thing, most)
                for thing, most in zip(scene.objects, wanted, strict=True)
            ]
            if all(options):
                chosen = _cheapest(options) if max_ms is None else self._most_precise(options, 1e-3 * max_ms)
                candidates.append((each, chosen))
        if not candidates:
            raise BudgetError(
                "no mask that was measured covers this scene's depths and noise, in both cameras where depth "
                "is wanted: bring the objects closer together, or state their depths more precisely"
            )
        plans = [self._assembled(scene, each, chosen, wanted) for each, chosen in candidates]
        if max_ms is not None:
            affordable = [plan for plan in plans if plan.time_s <= 1e-3 * max_ms]
            if not affordable:
                nearest = explained(min(plans, key=lambda p: p.time_s), plans)
                raise BudgetError(
                    f"no plan sees this scene in {max_ms:g} ms: the quickest takes "
                    f"{1e3 * nearest.time_s:.3g} ms and errs by up to {nearest.error_um:.2g} um, so allow "
                    "that or follow fewer features",
                    nearest,
                )
            return explained(min(affordable, key=lambda p: (p.excess, p.time_s)), plans)
        enough = [plan for plan in plans if plan.excess <= 1]
        if not enough:
            best = self._nearest(scene, masks, wanted)
            worst = max(best.objects, key=lambda thing: thing.excess)
            depth = worst.error_um <= worst.wanted_um and worst.depth_error_um is not None
            asked = worst.depth_wanted_um if depth else worst.wanted_um
            possible = worst.depth_error_um if depth else worst.error_um
            raise BudgetError(
                f"no plan sees '{worst.name}' to {asked:.3g} um{' in depth' if depth else ''}: the nearest "
                f"possible is {possible:.3g} um in {1e3 * best.time_s:.3g} ms, so allow that, state its "
                "depth more precisely or bring the objects closer together in depth",
                explained(best, [best]),
            )
        return explained(min(enough, key=lambda p: (p.time_s, p.excess)), plans)

    def predict_s(self, chain: Chain, features: int) -> float:
        """Return the predicted time of one object's chain while its filter stands."""
        return self._times.chain(chain, features, self.profile.shape)

    def masks(self, scene: Scene) -> Iterator[Mask]:
        """Return the masks worth considering: none, and coded, focused between the objects and on each."""
        optics = scene.optics
        ends = [
            optics.psi_rad(thing.depth_um + sign * _SIGMAS * thing.depth_sigma_um)
            for thing in scene.objects
            for sign in (-1, 1)
        ]
        middle = (min(ends) + max(ends)) / 2
        foci = list(dict.fromkeys([middle, *(optics.psi_rad(thing.depth_um) for thing in scene.objects)]))
        if len(scene.objects) == 1:
            foci = foci[:1]
        for focus in foci:
            yield Mask(0.0, -focus)
        for focus in foci:
            reach = max(max(ends) - focus, focus - min(ends))
            for share in SHARES if focus == middle else SHARES[1:2]:
                alpha = max(reach / (3 * share), float(self._errors.alphas[0]))
                if focus == middle or alpha <= self._errors.focused_alpha_rad:
                    yield Mask(alpha, -focus)

    # ---- inside -------------------------------------------------------------------------------------------

    def _require_measured(self, scene: Scene) -> None:
        most = float(self._errors.noises[-1])
        if scene.noise_grey > most:
            raise InputError(
                f"noise_grey is {scene.noise_grey:g}: errors were measured up to {most:.3g}, so use more "
                "light or average frames"
            )
        optics = scene.optics
        blur = optics.wavelength_um * optics.f_number / optics.object_pitch_um
        if abs(math.log(blur / self.profile.blur_px)) > math.log(_OPTICS_ALIKE):
            raise InputError(
                f"the optics blur {blur:.3g} pixels (wavelength x f-number / pitch): errors were measured at "
                f"{self.profile.blur_px:.3g}, and hold within a factor of {_OPTICS_ALIKE:g} of it"
            )

    @staticmethod
    def _wanted_um(
        scene: Scene, thing: SceneObject, max_error_um: float | None, max_ms: float | None
    ) -> float:
        stated = thing.accuracy_um.get(scene.phase)
        budgets = [value for value in (stated, max_error_um) if value is not None]
        if not budgets and max_ms is None:
            raise InputError(
                f"'{thing.name}' states no accuracy for phase '{scene.phase}' and no budget came: give "
                "max_error_um or max_ms"
            )
        if thing.depth_accuracy_um.get(scene.phase) is not None and scene.mask_2 is None:
            raise InputError(
                f"'{thing.name}' wants its depth in phase '{scene.phase}' and the scene has no mask_2: state "
                "camera 2's mask, or want no depth"
            )
        return min(budgets) if budgets else 1.0

    def choices(self, scene: Scene, mask: Mask, thing: SceneObject, wanted_um: float) -> list[Choice]:
        """Return every way to see an object under a mask that finds its features at all."""
        blur = _Defocus.of(scene.optics, mask, thing.depth_um, thing.depth_sigma_um)
        drift_um = abs(thing.speed_um_per_s) / scene.frame_rate_hz
        if drift_um > self._margin_um(mask, blur):
            return []  # out of the mask's range before the next frame
        tolerance = self.tolerance_rad(scene.optics, mask, blur, wanted_um)
        firsts = [
            (chain, seconds + self._forming_s(scene, thing, chain, tolerance), error_um)
            for chain, seconds, error_um in self._ways(scene, thing, mask.alpha_rad, blur)
        ]
        asked = thing.depth_accuracy_um.get(scene.phase)
        known = _SIGMAS * thing.depth_sigma_um
        if asked is None or (known <= asked and thing.speed_um_per_s == 0):
            depth = None if asked is None else known
            return [
                Choice(c, None, 0, t, e, depth, max(e / wanted_um, 0.0 if asked is None else known / asked))
                for c, t, e in firsts
            ]
        choices = []
        tilt = math.radians(scene.tilt_deg)
        for (chain, seconds, error_um), (second, more, error_2) in product(
            _unbeaten(firsts), _unbeaten(self._by_camera_2(scene, thing))
        ):
            # Along x, in which the cameras differ, an error that has no direction is this much smaller.
            depth_um = math.hypot(error_um * math.cos(tilt), error_2) / math.sqrt(2) / math.sin(tilt)
            rarely = _MOST_FRAMES if drift_um == 0 else 1 + int(max(asked - depth_um, 0.0) / drift_um)
            for every in sorted({min(rarely, _MOST_FRAMES), *(n for n in _EVERY if n < rarely)}):
                after_um = depth_um + (every - 1) * drift_um
                excess = max(error_um / wanted_um, after_um / asked)
                choices.append(
                    Choice(chain, second, every, seconds + more / every, error_um, after_um, excess)
                )
        return choices

    def _kinds(
        self, alpha_rad: float, blur: _Defocus, noise_grey: float
    ) -> tuple[list[tuple[str, str]], Array]:
        if alpha_rad == 0:
            reach = abs(blur.psi_rad) + blur.sigma_rad
            return self._errors.plain, self._errors.without_mask(reach, noise_grey)
        share = (abs(blur.psi_rad) + blur.sigma_rad) / (3 * alpha_rad)
        errors = np.hypot(self._errors.with_mask(alpha_rad, share, noise_grey), blur.shift_px)
        return self._errors.restored, errors

    def _by_camera_2(self, scene: Scene, thing: SceneObject) -> list[tuple[Chain, float, float]]:
        assert scene.mask_2 is not None
        depth = thing.depth_um * math.cos(math.radians(scene.tilt_deg))
        blur = _Defocus.of(scene.optics, scene.mask_2, depth, thing.depth_sigma_um)
        return self._ways(scene, thing, scene.mask_2.alpha_rad, blur)

    def _ways(
        self, scene: Scene, thing: SceneObject, alpha_rad: float, blur: _Defocus
    ) -> list[tuple[Chain, float, float]]:
        """Return each chain that finds the object at all, with its time and its error in um.

        Searches and windows are the smallest that hold the object.
        """
        slack = 2 * (_PLACE_SIGMAS * thing.place_sigma_px + 1.5)
        search = next((side for side in SEARCHES if side >= TEMPLATE_PX + slack), None)
        if search is None:
            raise InputError(
                f"'{thing.name}' may appear {_PLACE_SIGMAS * thing.place_sigma_px:.0f} px from where it is "
                f"expected: at most {(SEARCHES[-1] - TEMPLATE_PX) / 2 - 1.5:.0f} can be searched, so "
                "predict its place"
            )
        # Half of the blur's width on each side is what a restored feature draws on.
        support = scene.optics.support_px(alpha_rad, blur.psi_rad) if alpha_rad else 0.0
        side = thing.extent_px + search + 2 * max(support / 2, 8.0)
        window = next((w for w in WINDOWS if side <= w <= min(scene.shape)), 0)
        kinds, errors = self._kinds(alpha_rad, blur, scene.noise_grey)
        pitch = scene.optics.object_pitch_um
        return [
            (chain, self._times.chain(chain, thing.features, scene.shape), error_px * pitch)
            for (restoration, refine), error_px in zip(kinds, errors.tolist(), strict=True)
            if math.isfinite(error_px) and self._times.knows(restoration)
            for chain in (Chain(restoration, window, refine, TEMPLATE_PX, search),)
        ]

    @staticmethod
    def tolerance_rad(optics: OpticalSystem, mask: Mask, blur: _Defocus, wanted_um: float) -> float:
        """Return how far a filter may be from its object's defocus: a tenth of the accuracy's worth."""
        if mask.alpha_rad == 0:
            return _MOST_TOLERANCE_RAD
        share = max(abs(blur.psi_rad) / (3 * mask.alpha_rad), 0.05)
        px_per_rad = math.sqrt(2) * 2 * share * _blur_px_per_rad(optics)
        allowed = _FILTER_SHARE * wanted_um / optics.object_pitch_um / px_per_rad
        return min(max(allowed, SAME_RAD), _MOST_TOLERANCE_RAD)

    def _forming_s(self, scene: Scene, thing: SceneObject, chain: Chain, tolerance_rad: float) -> float:
        """Return what forming its filter costs per frame while it moves in depth."""
        if chain.restoration == "none" or thing.speed_um_per_s == 0:
            return 0.0
        drift_um = abs(thing.speed_um_per_s) / scene.frame_rate_hz
        drift_rad = abs(
            scene.optics.psi_rad(thing.depth_um + drift_um) - scene.optics.psi_rad(thing.depth_um)
        )
        return self._times.form(chain, scene.shape) * min(1.0, drift_rad / tolerance_rad)

    def _most_precise(self, options: Sequence[Sequence[Choice]], most_s: float) -> list[Choice]:
        """Start with each object's quickest; refine the worst while time is left."""
        fronts = [_front(choices) for choices in options]
        at = [0] * len(fronts)
        saved = self._times.shared_s * (len(fronts) - 1)
        while True:
            worst = max(range(len(fronts)), key=lambda i: fronts[i][at[i]].excess)
            if at[worst] + 1 == len(fronts[worst]):
                break
            spent = sum(front[i].time_s for front, i in zip(fronts, at, strict=True)) - saved
            more = fronts[worst][at[worst] + 1].time_s - fronts[worst][at[worst]].time_s
            if spent + more > most_s:
                break
            at[worst] += 1
        return [front[i] for front, i in zip(fronts, at, strict=True)]

    def _nearest(self, scene: Scene, masks: Sequence[Mask], wanted: Sequence[float]) -> Plan:
        """Return the plan whose errors exceed what was wanted least."""
        found = []
        for mask in masks:
            options = [self.choices(scene, mask, o, w) for o, w in zip(scene.objects, wanted, strict=True)]
            if all(options):
                chosen = [min(choices, key=lambda c: (c.excess, c.time_s)) for choices in options]
                found.append(self._assembled(scene, mask, chosen, wanted))
        return min(found, key=lambda plan: (plan.excess, plan.time_s))

    def _assembled(self, scene: Scene, mask: Mask, chosen: Sequence[Choice], wanted: Sequence[float]) -> Plan:
        objects = []
        for thing, choice, most in zip(scene.objects, chosen, wanted, strict=True):
            blur = _Defocus.of(scene.optics, mask, thing.depth_um, thing.depth_sigma_um)
            objects.append(
                ObjectPlan(
                    name=thing.name,
                    chain=choice.chain,
                    second=choice.second,
                    every=choice.every,
                    tolerance_rad=self.tolerance_rad(scene.optics, mask, blur, most),
                    time_s=choice.time_s,
                    error_um=choice.error_um,
                    wanted_um=most,
                    depth_error_um=choice.depth_um,
                    depth_wanted_um=thing.depth_accuracy_um.get(scene.phase),
                    depth_margin_um=self._margin_um(mask, blur),
                )
            )
        time_s = sum(thing.time_s for thing in objects) - self._times.shared_s * (len(objects) - 1)
        return Plan(mask, tuple(objects), time_s)

    def _margin_um(self, mask: Mask, blur: _Defocus) -> float:
        """Return how much deeper or nearer an object may be before the mask's measured range ends."""
        end = (
            3 * mask.alpha_rad * float(self._errors.shares[-1])
            if mask.alpha_rad
            else float(self._errors.flat[-1])
        )
        return max(end - abs(blur.psi_rad), 0.0) / blur.rad_per_um

    # ---- sentences ----------------------------------------------------------------------------------------

    def _explained(self, scene: Scene, plan: Plan, others: Sequence[Plan]) -> Plan:
        reasons = [self._mask_sentence(scene, plan, others)]
        reasons += [self._object_sentence(scene, plan.mask, thing) for thing in plan.objects]
        return Plan(plan.mask, plan.objects, plan.time_s, tuple(reasons), tuple(self._left_out(scene, plan)))

    def _mask_sentence(self, scene: Scene, plan: Plan, others: Sequence[Plan]) -> str:
        optics, mask = scene.optics, plan.mask
        psis = {thing.name: mask.psi_rad(optics, thing.depth_um) for thing in scene.objects}
        worst = max(psis, key=lambda name: abs(psis[name]))
        focus_um = optics.depth_um(-mask.focus_psi_rad)
        on = next((o.name for o in scene.objects if abs(o.depth_um - focus_um) < 1), "")
        where = f"on '{on}'" if on else f"at {focus_um:.0f} um, between the objects"
        totals = f"{1e3 * plan.time_s:.3g} ms and {plan.error_um:.2g} um in all"
        if mask.alpha_rad == 0:
            return (
                f"no mask, focus {where}: '{worst}' is only {abs(psis[worst]):.1f} rad out of focus, which "
                f"features bear unrestored; {totals}"
            )
        flat = [other for other in others if other.mask.alpha_rad == 0 and math.isfinite(other.excess)]
        without = (
            f"without a mask the error would be {min(o.error_um for o in flat):.2g} um"
            if flat
            else f"without a mask '{worst}' would be lost"
        )
        left = abs(psis[worst])
        return (
            f"mask of alpha {mask.alpha_rad:.1f}, focus {where}: it leaves {left:.1f} rad of defocus, "
            f"{left / (3 * mask.alpha_rad):.2f} of its band, at '{worst}'; {without}; {totals}"
        )

    def _object_sentence(self, scene: Scene, mask: Mask, plan: ObjectPlan) -> str:
        thing = next(o for o in scene.objects if o.name == plan.name)
        chain = plan.chain
        seen = f"in a window of {chain.window_px} px" if chain.window_px else "in the whole frame"
        how = (
            "unrestored"
            if chain.restoration == "none"
            else f"restored for its own depth, {chain.restoration},"
        )
        sentence = (
            f"'{plan.name}' {how} {seen}, {chain.refine.replace('_', '-')} within {chain.search_px} px: "
            f"{1e3 * plan.time_s:.3g} ms, errs by up to {plan.error_um:.2g} um where "
            f"{plan.wanted_um:.3g} are allowed"
        )
        if chain.restoration != "none":
            psi = mask.psi_rad(scene.optics, thing.depth_um)
            quality = filter_quality(scene.optics, mask.alpha_rad, psi, self.profile.nsr)
            sentence += (
                f"; restored noise is {quality.noise_gain:.2g} times the frame's, detail is kept to "
                f"{quality.resolution_lp_per_mm:.0f} lp/mm"
            )
        cheaper = [
            c
            for c in self.choices(scene, mask, thing, plan.wanted_um)
            if c.time_s < plan.time_s and c.error_um > plan.wanted_um
        ]
        if cheaper:
            best = min(cheaper, key=lambda c: c.error_um)
            sentence += (
                f"; {best.chain.refine.replace('_', '-')} would take {1e3 * best.time_s:.3g} ms and err by "
                f"{best.error_um:.2g} um"
            )
        if plan.second is not None:
            sentence += (
                f"; camera 2 every {plan.every} frames, {plan.second.refine.replace('_', '-')}, for a depth "
                f"good to {plan.depth_error_um:.3g} um where {plan.depth_wanted_um:.3g} are allowed"
            )
        return sentence

    def _left_out(self, scene: Scene, plan: Plan) -> Iterator[str]:
        rows, columns = scene.shape
        windows = [thing.chain.window_px for thing in plan.objects]
        if all(windows):
            kept = sum(side**2 for side in windows) / (rows * columns)
            yield (
                f"{100 * max(1 - kept, 0):.0f} % of the frame's pixels: windows hold every template, three "
                "sigma of where it may be, and half of the blur's width around"
            )
        if all(thing.chain.restoration == "none" for thing in plan.objects):
            yield "restoration: nothing is blurred beyond what an unrestored search was measured to bear"
        elif all(thing.chain.restoration != "float64" for thing in plan.objects):
            kinds = sorted({thing.chain.restoration for thing in plan.objects} - {"none"})
            yield (
                f"float64: {' and '.join(kinds)} storage was measured within these errors, and float64 "
                "moves no feature that optics and noise do not move further"
            )
        blind = [thing.name for thing in plan.objects if thing.second is None]
        if blind:
            reasons = [
                "known well enough"
                if thing.depth_wanted_um is not None
                else f"not wanted in phase '{scene.phase}'"
                for thing in plan.objects
                if thing.second is None
            ]
            named = ", ".join(f"'{n}'" for n in blind)
            yield f"camera 2 for {named}: depth is {' and '.join(dict.fromkeys(reasons))}"
        margin = min(plan.objects, key=lambda thing: thing.depth_margin_um)
        yield (
            f"a stronger mask: '{margin.name}' may be {margin.depth_margin_um:.0f} um from its stated depth "
            "before this one no longer covers it"
        )
        still = [o.name for o in scene.objects if o.speed_um_per_s == 0]
        if still and any(thing.chain.restoration != "none" for thing in plan.objects):
            yield f"new filters for {', '.join(repr(n) for n in still)}: nothing there moves in depth"


@dataclass(frozen=True)
class _Defocus:
    """An object's defocus under a mask, and what not knowing its depth exactly does.

    Attributes
    ----------
    sigma_rad
        How much farther out of focus it may be.
    shift_px
        How far a filter for the wrong depth may displace it, along both axes (docs/maths.md, eq. O7).
    """

    psi_rad: float
    sigma_rad: float
    shift_px: float
    rad_per_um: float

    @classmethod
    def of(cls, optics: OpticalSystem, mask: Mask, depth_um: float, sigma_um: float) -> _Defocus:
        psi = mask.psi_rad(optics, depth_um)
        rad_per_um = abs(optics.psi_rad(depth_um + 1.0) - optics.psi_rad(depth_um))
        sigma = _SIGMAS * sigma_um * rad_per_um
        shift = 0.0
        if mask.alpha_rad:
            share = abs(psi) / (3 * abs(mask.alpha_rad))
            shift = math.sqrt(2) * 2 * share * sigma * _blur_px_per_rad(optics)
        return cls(psi, sigma, shift, rad_per_um)


def _blur_px_per_rad(optics: OpticalSystem) -> float:
    return optics.wavelength_um * optics.f_number / (math.pi * optics.object_pitch_um)


def _unbeaten(ways: Sequence[tuple[Chain, float, float]]) -> list[tuple[Chain, float, float]]:
    """Return the ways that no other beats in both time and error, quickest first."""
    front: list[tuple[Chain, float, float]] = []
    for way in sorted(ways, key=lambda w: w[1:]):
        if not front or way[2] < front[-1][2]:
            front.append(way)
    return front


def _cheapest(options: Sequence[Sequence[Choice]]) -> list[Choice]:
    """Return each object's quickest choice that is precise enough, or its most precise one."""
    chosen = []
    for choices in options:
        enough = [choice for choice in choices if choice.excess <= 1]
        chosen.append(
            min(enough, key=lambda c: (c.time_s, c.excess))
            if enough
            else min(choices, key=lambda c: c.excess)
        )
    return chosen


def _front(choices: Sequence[Choice]) -> list[Choice]:
    """Return the choices that no other beats in both time and excess, quickest first."""
    front: list[Choice] = []
    for choice in sorted(choices, key=lambda c: (c.time_s, c.excess)):
        if not front or choice.excess < front[-1].excess:
            front.append(choice)
    return front


EXACT = Chain("float64", 0, "gauss_newton", TEMPLATE_PX, SEARCHES[-1])
"""Everything exact, the whole frame, in float64: what plans are compared with."""
