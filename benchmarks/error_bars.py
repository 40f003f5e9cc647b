"""Does each error bar hold? Ellipses of features and sigmas of depth, against the twin's truth.

    python benchmarks/error_bars.py                     2000 draws over 40 specimens
    python benchmarks/error_bars.py --draws 400 --nsr 0.01 --json error_bars.json

A draw is a pair of frames: parts somewhere else, at other depths, through another mask, with new noise, and
with templates taken anew, as the loop takes them, at another place and depth. Counted is how often the truth
lies in the 95 % ellipse of a feature, and within 1.96 sigma of a depth whose cameras were calibrated anew,
with noise; beside it the scatter that so many draws leave, and the median of the squared distances in units
of the bar: 1.39 for a feature, 0.45 for a depth, where the bars are right on average.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adof_cl.device import Device
from adof_cl.loop import Options, cut_templates, still_picture
from adof_cl.mask import ModelCalibration, choose_mask
from adof_cl.optics import Mask
from adof_cl.pipeline import CameraPipeline
from adof_cl.specimen import PARTS, Specimen
from adof_cl.stereo import StereoRig, calibrate_camera, triangulate_relative
from adof_cl.tracking import Measurement, Template, TrackingLimits

Array = NDArray[np.float64]

INSIDE_2D = 5.991  # of chi squared with two degrees of freedom, 95 % lie below
INSIDE_1D = 3.841
FRAMES_TAUGHT = 4
FIRST_SEED = 500
_CALIBRATION_PX = 0.05


@dataclass(frozen=True)
class Row:
    """One error bar, and how far off the truth was.

    Attributes
    ----------
    what
        "feature" or "depth".
    distance2
        Squared error in units of the bar: a Mahalanobis distance.
    lost
        Refused: no bar was given.
    """

    what: str
    part: str
    camera: int
    depth_um: float
    alpha_rad: float
    distance2: float
    error: tuple[float, ...]
    sigma: tuple[float, ...]
    lost: bool


class Draws:
    """Frames, templates and calibrations of one specimen, drawn anew each time."""

    def __init__(self, device: Device, seed: int, nsr: float) -> None:
        self.rng = np.random.default_rng([seed, 19])
        aside = self.rng.uniform(120, 280, 2)
        self.specimen = Specimen(
            device, seed, offset_um=(float(aside[0]), -float(aside[1])),
            turn_rad=float(self.rng.uniform(-0.04, 0.04)),
        )  # fmt: skip
        design = self.specimen.design
        self._model = ModelCalibration(design.optics_1)
        self._pipelines = {
            camera: CameraPipeline(device, optics, self.specimen.shape, PARTS, nsr=nsr, padding=100)
            for camera, optics in ((1, design.optics_1), (2, design.optics_2))
        }

    def draw(self) -> list[Row]:
        """Take templates, move everything, take a pair of frames and judge every error bar."""
        rng, specimen = self.rng, self.specimen
        near = bool(rng.random() < 0.5)
        self._place(900.0 if near else 3900.0)
        templates = self._taught()
        self._place(float(rng.uniform(400, 1000) if near else rng.uniform(900, 3900)))
        depth_um = specimen.depth_um("hole") - specimen.depth_um("peg")
        mask = self._mask(float(rng.choice([1.0, 1.0, 1.5])))
        rows: list[Row] = []
        seen: dict[int, Mapping[str, Sequence[Measurement]]] = {}
        for camera, pipeline in self._pipelines.items():
            taken = specimen.expose(mask, camera=camera)
            for part in PARTS:
                pipeline.set_templates(part, templates[part, camera], TrackingLimits(mismatch=0.7))
            blurs = {part: specimen.blur(part, mask, camera=camera) for part in PARTS}
            seen[camera] = pipeline(taken.pixels, blurs, taken.corners_px)
            for part in PARTS:
                for measured, truth in zip(seen[camera][part], taken.corners_px[part], strict=True):
                    error = measured.feature_xy_px - truth
                    far = math.nan if measured.lost else error @ np.linalg.solve(measured.covariance, error)
                    sigma = np.sqrt(np.diag(measured.covariance))
                    rows.append(
                        Row("feature", part, camera, depth_um, mask.alpha_rad, float(far),
                            tuple(error.tolist()), tuple(sigma.tolist()), measured.lost)
                    )  # fmt: skip
        rows.append(self._depth(seen, depth_um, mask))
        return rows

    def _place(self, depth_um: float) -> None:
        hole, peg = self.rng.uniform(-8, 8, 2), self.rng.uniform(-8, 8, 2)
        self.specimen.place(depth_um, (float(hole[0]), float(hole[1])), (float(peg[0]), float(peg[1])))

    def _mask(self, stronger: float) -> Mask:
        """Choose a mask as the loop does: |psi| at most 0.6 of 3 alpha."""
        optics = self.specimen.optics
        ends = sorted(self.specimen.depth_um(part) for part in PARTS)
        mask = choose_mask(ends[0], ends[1], self._model, optics, joint=True)
        defocus = max(abs(mask.psi_rad(optics, end)) for end in ends)
        return replace(mask, alpha_rad=stronger * max(mask.alpha_rad, defocus / 1.8))

    def _taught(self) -> dict[tuple[str, int], list[Template]]:
        specimen = self.specimen
        templates = {}
        for part in PARTS:
            focused = Mask(0.0, -specimen.optics.psi_rad(specimen.depth_um(part)))
            for camera in (1, 2):
                taken = [specimen.expose(focused, camera=camera) for _ in range(FRAMES_TAUGHT)]
                pictures = [exposure.pixels for exposure in taken]
                if camera == 2:
                    blur = {part: specimen.blur(part, focused, camera=2)}
                    pictures = [self._pipelines[2].restored(p, blur)[part] for p in pictures]
                picture, noise = still_picture(pictures)
                templates[part, camera] = cut_templates(
                    picture, taken[0].corners_px[part], part, noise=noise, optics=specimen.optics
                )
        return templates

    def _stereo(self) -> StereoRig:
        """Calibrate both cameras with noisy pictures of a target stepped through the work volume."""
        x, y, z = (
            axis.ravel() for axis in np.meshgrid([-500, 500], [-300, 300], [0, 1000, 2000, 3000, 4000])
        )
        points = np.stack([x, y, z], axis=1).astype(np.float64)
        volume = np.array([[-600.0, -600.0, 0.0], [600.0, 600.0, 4000.0]])
        cameras = []
        for number in (1, 2):
            matrix, origin = self.specimen.rig.world.projection(number)
            pixels = points @ matrix.T + origin - np.array(self.specimen.design.region_origin_yx[::-1])
            pixels = pixels + self.rng.normal(0, _CALIBRATION_PX, pixels.shape)
            cameras.append(calibrate_camera(points, pixels, sigma_px=_CALIBRATION_PX, work_volume_um=volume))
        return StereoRig(cameras[0], cameras[1])

    def _depth(
        self, seen: Mapping[int, Mapping[str, Sequence[Measurement]]], depth_um: float, mask: Mask
    ) -> Row:
        measured = [m for parts in seen.values() for part in parts.values() for m in part]
        if any(m.lost for m in measured):
            return Row("depth", "both", 0, depth_um, mask.alpha_rad, math.nan, (), (), True)
        places: list[Array] = []
        covariances: list[Array] = []
        for part in PARTS:
            for camera in (1, 2):
                places.append(np.mean([m.feature_xy_px for m in seen[camera][part]], axis=0))
                covariances.append(np.sum([m.covariance for m in seen[camera][part]], axis=0) / 4)
        fix = triangulate_relative(
            self._stereo(), places[0], places[1], places[2], places[3],
            covariances[0] + covariances[2], covariances[1] + covariances[3],
        )  # fmt: skip
        error, sigma = float(fix.xyz_um[2]) - depth_um, float(fix.sigma_um[2])
        return Row(
            "depth", "both", 0, depth_um, mask.alpha_rad, (error / sigma) ** 2, (error,), (sigma,), False
        )


def draw(device: Device, specimens: Iterable[int], draws: int, nsr: float) -> list[Row]:
    """Judge the error bars of `draws` pairs of frames, spread over the specimens."""
    seeds = list(specimens)
    rows: list[Row] = []
    for number, seed in enumerate(seeds):
        made = Draws(device, FIRST_SEED + seed, nsr)
        for _ in range((draws + number) // len(seeds)):
            rows += made.draw()
    return rows


def share_inside(rows: Sequence[Row]) -> tuple[float, float, int]:
    """Return the share within its bar, the scatter that this many leave of it, and how many were judged."""
    far = np.array([row.distance2 / (INSIDE_2D if row.what == "feature" else INSIDE_1D)
                    for row in rows if not row.lost])  # fmt: skip
    share = float((far <= 1).mean()) if far.size else math.nan
    return share, math.sqrt(0.95 * 0.05 / max(far.size, 1)), int(far.size)


def groups(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Return the rows by what they are of: all, camera, part, depth, mask."""
    features = [row for row in rows if row.what == "feature"]
    depths = [row for row in rows if row.what == "depth"]
    found = {"features, all": features, "depths, all": depths}
    for camera in (1, 2):
        for part in PARTS:
            chosen = [row for row in features if (row.camera, row.part) == (camera, part)]
            found[f"camera {camera}, {part}"] = chosen
            for low, high in ((400, 1000), (1000, 2000), (2000, 3000), (3000, 4000)):
                name = f"camera {camera}, {part}, {low} to {high} um"
                found[name] = [row for row in chosen if low <= row.depth_um < high]
    for low, high in ((0, 10), (10, 20), (20, 30), (30, 60)):
        name = f"camera 1, alpha {low} to {high} rad"
        found[name] = [r for r in features if r.camera == 1 and low <= r.alpha_rad < high]
    for low, high in ((400, 1000), (1000, 2000), (2000, 4000)):
        found[f"depth of {low} to {high} um"] = [r for r in depths if low <= r.depth_um < high]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--specimens", type=int, default=40)
    parser.add_argument("--nsr", type=float, default=Options().nsr)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--device")
    arguments = parser.parse_args()
    device = Device.open(arguments.device)
    rows = draw(device, range(arguments.specimens), arguments.draws, arguments.nsr)
    figures = {}
    print(f"{'':36}{'inside':>9}{'+-':>7}{'of':>7}{'lost':>6}{'median':>8}{'rms error':>11}{'rms sigma':>11}")
    for name, chosen in groups(rows).items():
        share, scatter, count = share_inside(chosen)
        if not count:
            continue
        judged = [row for row in chosen if not row.lost]
        rms = math.sqrt(float(np.mean([np.square(row.error) for row in judged])))
        sigma = math.sqrt(float(np.mean([np.square(row.sigma) for row in judged])))
        median = float(np.median([row.distance2 for row in judged]))
        lost = len(chosen) - count
        unit = "um" if judged[0].what == "depth" else "px"
        print(f"{name:36}{100 * share:8.1f}%{100 * scatter:6.1f}%{count:7d}{lost:6d}{median:8.2f}"
              f"{rms:8.3f} {unit}{sigma:8.3f} {unit}")  # fmt: skip
        figures[name] = {"inside": share, "scatter": scatter, "count": count, "lost": lost, "median": median,
                         "rms_error": rms, "rms_sigma": sigma}  # fmt: skip
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
