"""Whatever comes: a public function answers with finite numbers or refuses with one of our errors.

Each case is a call that works. One argument at a time is then replaced by what a caller should not give, or
may give by mistake. What must be refused, although a finite number could be made of it, is listed apart.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest

from adof_cl import (
    autofocus,
    envelope,
    mask,
    noise,
    optics,
    otf,
    padding,
    phase_terms,
    psf,
    restoration_quality,
    servo,
    slm_encode,
    stereo,
    tracking,
    wiener,
)
from adof_cl.device import Device
from adof_cl.errors import AdofError, InputError, LimitError, TrackingError
from adof_cl.fft_passes import Passes
from adof_cl.image_prep import ImagePrep, Region
from adof_cl.optics import Mask, OpticalSystem, PupilGrid, SlmPanel
from adof_cl.otf_table import OtfTable
from adof_cl.pipeline import Blur, CameraPipeline
from adof_cl.pupil_phase import PupilPhase
from adof_cl.registration import as_seen, register
from adof_cl.restore import Restore
from adof_cl.scene import Scene, SceneObject
from adof_cl.ssd_search import LARGEST_LEVEL, SsdSearch
from adof_cl.stream import RestoredFrames
from adof_cl.wiener import WienerFilter

pytestmark = pytest.mark.filterwarnings("ignore")  # NumPy may warn of what is then refused

NUMBERS = (math.nan, math.inf, -math.inf, 0.0, -1.0, 1e300, -1e300, 1e-300, 5e-324)
COUNTS = (0, -1, 1, math.nan, 2.5)

OPTICS = OpticalSystem()
PANEL = SlmPanel("small", 16, 16, 8.0, 1.0, 60.0)
GREY = (255 * envelope._texture((48, 52), 3)).astype(np.uint8)
LEVELS = GREY.astype(np.float32) / 255
TEMPLATE = tracking.Template.cut(GREY, (24.0, 24.0), (12, 12))
STEP = np.kron(np.array([[0, 0], [0, 200.0]]), np.ones((60, 60)))
CAMERA, TILTED = (envelope._camera(angle, np.zeros(3)) for angle in (0.0, 0.6))
RIG = stereo.StereoRig(CAMERA, TILTED)
VOLUME = np.array([[-1e3] * 3, [1e3] * 3])
POINTS = np.random.default_rng(0).uniform(-3e3, 3e3, (12, 3))
PIXELS = TILTED.project(POINTS)
MODEL, PAPER = mask.ModelCalibration(), mask.PaperCalibration()
UM = servo.StageAxis("um", 0.1, 100)
AXES = servo.StageAxes(UM, UM, servo.StageAxis("rad", 1e-4, 0.1), UM)
LAW = servo.ServoLaw.from_delay(CAMERA, AXES, 0.1, 0.1)
FEATURES = np.array([[200.0, 200.0], [300.0, 210.0]])
OTF = np.ones((12, 11), complex)
SHAPE = (12, 20)

Call = Callable[..., object]

HOST: dict[str, tuple[Call, dict[str, Any]]] = {
    "OpticalSystem": (
        OpticalSystem,
        {
            "wavelength_um": 0.55,
            "aperture_um": 1e4,
            "f_number": 6.5,
            "magnification": 1.0,
            "pixel_pitch_um": 7.4,
        },
    ),
    "psi_rad": (OPTICS.psi_rad, {"depth_um": 100.0}),
    "depth_um": (OPTICS.depth_um, {"psi_rad": 10.0}),
    "normalised_frequency": (OPTICS.normalised_frequency, {"cycles_per_um": 0.01}),
    "frequency_axis": (OPTICS.frequency_axis, {"samples": 8}),
    "pixel_otf_axis": (OPTICS.pixel_otf_axis, {"samples": 8}),
    "shift_px": (OPTICS.shift_px, {"alpha_rad": 20.0, "psi_rad": 10.0}),
    "support_px": (OPTICS.support_px, {"alpha_rad": 20.0, "psi_rad": 10.0}),
    "PupilGrid": (lambda samples: PupilGrid(samples).x, {"samples": 8}),
    "nyquist_samples": (PupilGrid.nyquist_samples, {"alpha_rad": 20.0, "psi_rad": 10.0}),
    "SlmPanel": (
        SlmPanel,
        {
            "name": "s",
            "rows": 8,
            "columns": 8,
            "pitch_um": 8.0,
            "fill_factor": 0.5,
            "frame_rate_hz": 60.0,
            "stroke_rad": 6.0,
        },
    ),
    "stop_px": (PANEL.stop_px, {"aperture_um": 1e3}),
    "Mask": (Mask, {"alpha_rad": 1.0, "focus_psi_rad": 1.0}),
    "PaperCalibration.alpha_rad": (PAPER.alpha_rad, {"depth_um": 2000.0}),
    "PaperCalibration.depth_um": (PAPER.depth_um, {"alpha_rad": 20.0}),
    "ModelCalibration": (
        lambda **k: mask.ModelCalibration(**k).alpha_rad(1000.0),
        {"criterion_lp_per_mm": 20.0, "threshold": 0.09, "sensor_share": 0.78},
    ),
    "ModelCalibration.alpha_rad": (MODEL.alpha_rad, {"depth_um": 2000.0}),
    "ModelCalibration.depth_um": (MODEL.depth_um, {"alpha_rad": 20.0}),
    "ModelCalibration.contrast": (MODEL.contrast, {"alpha_rad": 20.0, "psi_rad": 10.0, "lp_per_mm": 20.0}),
    "ModelCalibration.resolution": (MODEL.resolution_lp_per_mm, {"alpha_rad": 20.0}),
    "choose_mask": (
        lambda near_um, far_um: mask.choose_mask(near_um, far_um, MODEL, OPTICS, joint=True),
        {"near_um": -100.0, "far_um": 500.0},
    ),
    "filter_quality": (
        lambda **k: mask.filter_quality(OPTICS, **k),
        {"alpha_rad": 20.0, "psi_rad": 10.0, "nsr": 0.01, "samples": 32},
    ),
    "stationary_phase_otf": (
        otf.stationary_phase_otf,
        {"u": np.linspace(-1, 1, 9), "alpha_rad": 20.0, "psi_rad": 1.0},
    ),
    "noise_to_signal": (noise.noise_to_signal, {"frame": np.ones(SHAPE), "otf": OTF, "padded": SHAPE}),
    "psf_otf": (wiener.psf_otf, {"psf": np.ones((3, 3)), "shape": SHAPE, "centre_yx": (1, 1)}),
    "good_size": (padding.good_size, {"at_least": 11}),
    "padded_shape": (padding.padded_shape, {"shape": SHAPE, "padding": 3}),
    "padding_weights": (lambda samples: padding.padding_weights(samples, True), {"samples": 3}),
    "padded_frame": (padding.padded_frame, {"frame": np.ones(SHAPE), "padded": (14, 24)}),
    "Passes": (lambda n: Passes.of(n).order(), {"n": 12}),
    "samples_for": (psf.samples_for, {"alpha_rad": 20.0, "psi_rad": 10.0}),
    "require_sampling": (psf.require_sampling, {"samples": 64, "alpha_rad": 1.0, "psi_rad": 1.0}),
    "stop_amplitude": (lambda samples: psf.stop_amplitude("round", samples), {"samples": 32}),
    "stroke_table": (slm_encode.stroke_table, {"stroke_rad": 6.0}),
    "require_envelope": (phase_terms.require_envelope, {"alpha_rad": 1.0, "psi_rad": 1.0}),
    "restoration_quality": (
        restoration_quality.restoration_quality,
        {"otf": OTF, "nsr": 0.1, "padded": SHAPE},
    ),
    "sharpness": (autofocus.sharpness, {"image": LEVELS, "full_scale": 1.0}),
    "focus_sweep": (
        lambda **k: autofocus.focus_sweep(lambda z: math.exp(-z * z / 2), **k),
        {"low": -5.0, "high": 5.0, "coarse": 13, "rounds": 3},
    ),
    "focus_sweep's score": (
        lambda s: autofocus.focus_sweep(lambda z: s * math.exp(-z * z / 2), -5, 5),
        {"s": 1.0},
    ),
    "Template.cut": (
        tracking.Template.cut,
        {
            "image": LEVELS,
            "feature_xy_px": np.array([24.0, 24.0]),
            "shape": (12, 12),
            "noise": 0.01,
            "sigma_limit_px": 0.1,
        },
    ),
    "Template.anchored": (TEMPLATE.anchored, {"anchor_yx": np.array([6.0, 6.0])}),
    "estimate_noise": (tracking.estimate_noise, {"image": LEVELS}),
    "quadratic_minimum": (tracking.quadratic_minimum, {"neighbourhood": np.ones((3, 3))}),
    "extent_px": (
        lambda corners_px: tracking.extent_px([TEMPLATE], corners_px),
        {"corners_px": np.array([[24.0, 24.0]])},
    ),
    "GaussNewton": (
        tracking.GaussNewton([TEMPLATE]),
        {"patches": LEVELS[None, 10:38, 10:38], "start_yx": np.zeros((1, 2)), "iterations": 20},
    ),
    "TrackingLimits": (
        tracking.TrackingLimits,
        {"mismatch": 0.5, "sigma_px": 0.5, "gain": (0.1, 10.0), "displacement_px": 5.0},
    ),
    "locate_corner": (
        tracking.locate_corner,
        {
            "image": STEP,
            "guess_xy_px": np.array([60.0, 60.0]),
            "reach_px": 4.0,
            "arm_px": 30.0,
            "sigma_limit_px": 0.1,
        },
    ),
    "AffineCamera.exact": (
        stereo.AffineCamera.exact,
        {
            "matrix_px_per_um": CAMERA.matrix_px_per_um,
            "offset_px": np.array([1.0, 2.0]),
            "work_volume_um": VOLUME,
        },
    ),
    "AffineCamera.project": (CAMERA.project, {"points_um": np.ones((2, 3))}),
    "AffineCamera.pixel_covariance": (CAMERA.pixel_covariance, {"points_um": np.ones((2, 3))}),
    "AffineCamera.motion_um": (CAMERA.motion_um, {"displacement_px": np.ones((2, 2))}),
    "AffineCamera.sigma_um": (CAMERA.sigma_um, {"work_volume_um": VOLUME}),
    "calibrate_camera": (
        stereo.calibrate_camera,
        {
            "points_um": POINTS,
            "pixels_xy": PIXELS,
            "sigma_px": 0.1,
            "work_volume_um": VOLUME,
            "sigma_limit_um": 5.0,
        },
    ),
    "calibrate_camera's covariances": (
        lambda covariance_px2: stereo.calibrate_camera(POINTS, PIXELS, covariance_px2=covariance_px2),
        {"covariance_px2": np.tile(np.eye(2) * 0.01, (12, 1, 1))},
    ),
    "StereoRig": (
        lambda volume, limit: stereo.StereoRig(CAMERA, TILTED, volume, limit),
        {"volume": VOLUME, "limit": 5.0},
    ),
    "triangulate": (
        lambda a, b, c: stereo.triangulate(RIG, a, b, c),
        {"a": np.ones((2, 2)), "b": np.ones((2, 2)), "c": 0.01 * np.eye(2)},
    ),
    "triangulate_relative": (
        lambda a, b, c: stereo.triangulate_relative(RIG, a, b, c, a),
        {"a": np.ones((2, 2)), "b": np.ones((2, 2)), "c": np.ones((2, 2))},
    ),
    "StereoRig.sigma_z_um": (RIG.sigma_z_um, {"work_volume_um": VOLUME}),
    "image_jacobian": (
        lambda features, centre: servo.image_jacobian(CAMERA, features, centre),
        {"features": FEATURES, "centre": np.zeros(3)},
    ),
    "damped_pseudo_inverse": (
        servo.damped_pseudo_inverse,
        {"matrix": np.eye(3), "reference": 1.0, "damping": 0.1},
    ),
    "rotation_sigma_rad": (servo.rotation_sigma_rad, {"baseline_um": 100.0, "sigma_um": 1.0}),
    "samples_late": (servo.samples_late, {"delay_s": 0.1, "period_s": 0.1}),
    "stability_limit_per_s": (servo.stability_limit_per_s, {"delay_s": 0.1, "period_s": 0.1}),
    "gain_from_delay": (servo.gain_from_delay, {"delay_s": 0.1, "period_s": 0.1}),
    "require_stable_gain": (
        servo.require_stable_gain,
        {"gain_per_s": 1.0, "delay_s": 0.1, "period_s": 0.1},
    ),
    "StageAxis": (
        lambda **k: servo.StageAxis("um", **k),
        {"resolution": 0.1, "speed_limit": 100.0, "dead_band": 0.1, "hysteresis": 0.1},
    ),
    "saturate": (servo.saturate, {"velocities": np.ones(3), "limits": np.ones(3)}),
    "ServoLaw": (
        lambda **k: servo.ServoLaw(CAMERA, AXES, **k),
        {"gain_per_s": 1.0, "depth_gain_per_s": 1.0, "delay_s": 0.1, "period_s": 0.1, "damping": 0.1},
    ),
    "ServoLaw.retimed": (LAW.retimed, {"delay_s": 0.2, "period_s": 0.1}),
    "ServoLaw.step": (
        LAW.step,
        {
            "features_px": FEATURES,
            "desired_px": FEATURES + 1,
            "rotation_centre_um": np.zeros(3),
            "depth_error_um": 10.0,
        },
    ),
    "StageQuantiser.move": (
        lambda dt_s: servo.StageQuantiser(AXES).move(servo.VelocityCommand(1, 1, 0.01, 1), dt_s),
        {"dt_s": 0.1},
    ),
    "jog_test": (servo.jog_test, {"commanded": 10 * np.eye(3), "observed": 10 * np.eye(3)}),
}


@cache
def restore_plan(device: Device) -> Restore:
    plan = Restore(device, SHAPE, padding=3)
    plan.set_filter_axes(*(np.ones(n) for n in plan.padded_shape), 0.01)
    return plan


@cache
def wiener_plan(device: Device) -> WienerFilter:
    return WienerFilter(device, SHAPE)


@cache
def search_plan(device: Device, score: str) -> SsdSearch:
    plan = SsdSearch(device, GREY.shape, (9, 9), (20, 20), 1, dtype=np.float32, score=score)
    plan.set_windows(np.array([[6, 6]]))
    return plan


@cache
def tracker(device: Device) -> tracking.TemplateTracker:
    return tracking.TemplateTracker(device, GREY.shape, [TEMPLATE], (30, 30))


@cache
def pupil_plan(device: Device) -> PupilPhase:
    return PupilPhase(device, 32, 32)


@cache
def psf_plan(device: Device) -> psf.Psf:
    plan = psf.Psf(device, 32)
    plan(pupil_plan(device)(Mask(1, 1)))
    return plan


def restored(device: Device, frame: np.ndarray | None = None, **filter_axes: Any) -> object:
    plan = restore_plan(device)
    if filter_axes:
        plan.set_filter_axes(**filter_axes)
    return plan.restore(np.ones(SHAPE, np.float32) if frame is None else frame)


def restored_by(device: Device, gain: np.ndarray) -> object:
    restore_plan(device).set_filter(gain, 1)
    return restore_plan(device).restore(np.ones(SHAPE, np.float32), 1)


def searched(device: Device, score: str, templates: np.ndarray, image: np.ndarray) -> object:
    plan = search_plan(device, score)
    plan.set_templates(templates)
    found = plan.search(image)
    return found.best_yx, np.where(found.score == np.inf, 0, found.score)  # infinite: nothing there is finite


def tracked(device: Device, xy: Any, displacement: Any) -> object:
    (found,) = tracker(device).track(device.upload(GREY), xy, displacement_xy_px=displacement)
    return found if not found.lost else (found.feature_xy_px, found.ssd, found.mismatch, found.gain)


def with_profile(device: Device, x_rad: np.ndarray, map_rad: np.ndarray) -> object:
    plan = PupilPhase(device, 8, 8)
    plan.set_odd(x_rad)
    plan.set_map(map_rad)
    return plan.evaluate(Mask(1, 1))


def coded(device: Device, correction_rad: np.ndarray, aperture_um: float) -> object:
    system = dataclasses.replace(OPTICS, aperture_um=aperture_um)
    return slm_encode.SlmEncode(device, PANEL, system, correction_rad=correction_rad).codes(Mask(0.1, 0))


PADDED = padding.padded_shape(SHAPE, 3)
CUT = LEVELS[None, 10:19, 10:19].copy()

ON_DEVICE: dict[str, tuple[Call, dict[str, Any]]] = {
    "Otf1d": (
        lambda d, u, gain: otf.Otf1d(d, u, gain=gain).evaluate(1.0, 1.0),
        {"u": np.linspace(-1, 1, 9), "gain": np.ones(9)},
    ),
    "Otf1d's pairs": (lambda d, pairs: otf.Otf1d(d, np.ones(3), pairs=pairs).out.shape, {"pairs": 2}),
    "Otf1d.evaluate": (
        lambda d, **k: otf.Otf1d(d, np.linspace(-1, 1, 9)).evaluate(**k),
        {"alpha_rad": 1.0, "psi_rad": 1.0},
    ),
    "Otf1d.for_camera": (
        lambda d, samples: otf.Otf1d.for_camera(d, OPTICS, samples).evaluate(1.0, 1.0),
        {"samples": 8},
    ),
    "SeparableMaskOtf": (
        lambda d, samples: otf.SeparableMaskOtf(d, samples).evaluate(np.zeros(samples)),
        {"samples": 64},
    ),
    "SeparableMaskOtf.evaluate": (
        lambda d, **k: otf.SeparableMaskOtf(d, 64).evaluate(**k),
        {"profile_rad": np.zeros(64), "u": np.linspace(-1, 1, 5)},
    ),
    "WienerFilter": (lambda d, shape: WienerFilter(d, shape).filter_shape, {"shape": SHAPE}),
    "WienerFilter.from_otf_axes": (
        lambda d, **k: wiener_plan(d).from_otf_axes(**k).download(),
        {"h_rows": np.ones(12), "h_cols": np.ones(20), "nsr": 0.1},
    ),
    "WienerFilter.from_otf": (
        lambda d, **k: wiener_plan(d).from_otf(**k).download(),
        {"otf": OTF, "nsr": np.full((12, 11), 0.1)},
    ),
    "Psf": (lambda d, **k: psf.Psf(d, **k).size, {"samples": 32, "padding": 2}),
    "Psf's stop": (
        lambda d, stop: [a.download() for a in psf.Psf(d, 32, stop=stop)(pupil_plan(d)(Mask(1, 1)))],
        {"stop": np.ones((32, 32))},
    ),
    "Psf's call": (
        lambda d, **k: [a.download() for a in psf_plan(d)(pupil_plan(d)(Mask(1, 1)), **k)],
        {"alpha_rad": 1.0, "psi_rad": 1.0},
    ),
    "Psf.camera_otf": (lambda d, shape: psf_plan(d).camera_otf(OPTICS, shape), {"shape": (8, 9)}),
    "PupilPhase": (
        lambda d, **k: PupilPhase(d, **k).evaluate(Mask(1, 1)),
        {"rows": 8, "columns": 8},
    ),
    "PupilPhase.evaluate": (
        lambda d, tilt: pupil_plan(d).evaluate(Mask(1, 1), tilt_xy_rad=tilt),
        {"tilt": (1.0, 1.0)},
    ),
    "PupilPhase's profiles": (with_profile, {"x_rad": np.zeros(8), "map_rad": np.zeros((8, 8))}),
    "SlmEncode": (coded, {"correction_rad": np.zeros((16, 16)), "aperture_um": 100.0}),
    "SlmEncode.codes": (
        lambda d, tilt: slm_encode.SlmEncode(d, PANEL, dataclasses.replace(OPTICS, aperture_um=100.0)).codes(
            Mask(0.1, 0), tilt_xy_rad=tilt
        ),
        {"tilt": (0.1, 0.1)},
    ),
    "Restore": (
        lambda d, shape, padding: Restore(d, shape, padding=padding).padded_shape,
        {"shape": SHAPE, "padding": 3},
    ),
    "Restore.set_filter_axes": (
        restored,
        {"h_rows": np.ones(PADDED[0]), "h_cols": np.ones(PADDED[1]), "nsr": 0.01, "slot": 0},
    ),
    "Restore.set_filter": (restored_by, {"gain": np.ones((PADDED[0], PADDED[1] // 2 + 1))}),
    "Restore.restore": (restored, {"frame": np.ones(SHAPE, np.float32)}),
    "Restore.set_filter_table": (
        lambda d, **k: restore_plan(d).set_filter_table(
            d.upload(np.ones((2, sum(PADDED)), np.complex64)), **k
        ),
        {"nsr": 0.1, "slot": 2, "entry": 1},
    ),
    "Restore.line_gain": (
        lambda d, gain: restore_plan(d).line_gain(gain),
        {"gain": np.ones((PADDED[0], PADDED[1] // 2 + 1))},
    ),
    "SsdSearch": (
        lambda d, **k: SsdSearch(d, **k).offsets_shape,
        {
            "image_shape": (48, 52),
            "template_shape": (9, 9),
            "search_shape": (20, 20),
            "count": 1,
            "patch_margin": 2,
        },
    ),
    "SsdSearch.search, ssd": (lambda d, **k: searched(d, "ssd", **k), {"templates": CUT, "image": LEVELS}),
    "SsdSearch.search, gain_offset": (
        lambda d, **k: searched(d, "gain_offset", **k),
        {"templates": CUT, "image": LEVELS},
    ),
    "SsdSearch.set_windows": (
        lambda d, origins: search_plan(d, "ssd").set_windows(origins, clamp=True),
        {"origins": np.array([[6, 6]])},
    ),
    "ImagePrep": (
        lambda d, frame_shape: ImagePrep(d, frame_shape).frame_shape,
        {"frame_shape": SHAPE},
    ),
    "ImagePrep's region": (
        lambda d, **k: ImagePrep(d, SHAPE, region=Region(**k)).prepare(np.ones(SHAPE, np.uint8)),
        {"top": 1, "left": 1, "rows": 4, "columns": 4},
    ),
    "ImagePrep's maps": (
        lambda d, **k: ImagePrep(d, SHAPE, **k).prepare(np.full(SHAPE, 255, np.uint8)),
        {"dark": np.ones(SHAPE), "gain": 2.0},
    ),
    "TemplateTracker": (
        lambda d, image_shape, search_shape, full_scale: (
            tracking.TemplateTracker(
                d, image_shape, [TEMPLATE], search_shape, full_scale=full_scale
            ).full_scale
        ),
        {"image_shape": GREY.shape, "search_shape": (30, 30), "full_scale": 255.0},
    ),
    "TemplateTracker.track": (tracked, {"xy": np.array([[24.0, 24.0]]), "displacement": np.zeros(2)}),
}


def followed(device: Device, alpha: float, psi: float, xy: np.ndarray, frame: np.ndarray) -> object:
    plan = camera_plan(device)
    blur = Blur(alpha, psi)
    (found,) = plan(frame, {"peg": blur}, {"peg": xy})["peg"]
    return found if not found.lost else (found.feature_xy_px, found.ssd, found.mismatch, found.gain)


@cache
def camera_plan(device: Device) -> CameraPipeline:
    plan = CameraPipeline(device, OPTICS, GREY.shape, ("peg",), padding=8, search_shape=(30, 30))
    plan.set_templates("peg", [TEMPLATE])
    return plan


@cache
def table(device: Device) -> OtfTable:
    return OtfTable(device, OPTICS, SHAPE, entries=2)


def tabled(device: Device, pairs: Any) -> object:
    table(device).update(pairs)
    return table(device).axes(1)


ON_DEVICE |= {
    "OtfTable": (
        lambda d, shape, entries: OtfTable(d, OPTICS, shape, entries=entries).out.shape,
        {"shape": SHAPE, "entries": 2},
    ),
    "OtfTable.update": (tabled, {"pairs": np.array([[1.0, 2.0], [3.0, 4.0]])}),
    "OtfTable.update_depths": (
        lambda d, depth: (table(d).update_depths(Mask(1, 1), (0.0, depth)), table(d).axes(1)),
        {"depth": 100.0},
    ),
    "OtfTable.otf": (lambda d, entry: (tabled(d, [(1, 2), (3, 4)]), table(d).otf(entry)), {"entry": 1}),
    "CameraPipeline": (
        lambda d, **k: CameraPipeline(d, OPTICS, GREY.shape, ("peg",), **k).shape,
        {"nsr": 0.01, "padding": 8, "search_shape": (30, 30), "tolerance_rad": 0.01, "buffers": 1},
    ),
    "CameraPipeline's call": (
        followed,
        {"alpha": 1.0, "psi": 0.5, "xy": np.array([[24.0, 24.0]]), "frame": GREY},
    ),
    "RestoredFrames": (
        lambda d, buffers: RestoredFrames(restore_plan(d), buffers=buffers).buffers,
        {"buffers": 2},
    ),
}


@dataclasses.dataclass(frozen=True)
class Picture:
    """A drawing of its own: random marks."""

    radiance: np.ndarray
    judged: np.ndarray
    pitch_um: float = 10.0
    centre_yx: tuple[float, float] = (60.0, 60.0)


MARKS = Picture(
    np.kron(np.random.default_rng(5).random((30, 30), np.float32), np.ones((4, 4), np.float32)),
    np.ones((120, 120), np.bool_),
)
SCALE = 0.05 * np.eye(2)
MARKED = np.pad(as_seen(MARKS, SCALE)[0], 12, mode="edge")

HOST |= {
    "as_seen": (
        lambda matrix, fraction_px: as_seen(MARKS, matrix, fraction_px),
        {"matrix": SCALE, "fraction_px": np.array([0.2, 0.3])},
    ),
    "register": (
        lambda image, matrix, expected_px, reach_px: register(
            image, MARKS, matrix, expected_px=expected_px, reach_px=reach_px
        ),
        {"image": MARKED, "matrix": SCALE, "expected_px": np.array([42.0, 42.0]), "reach_px": 6.0},
    ),
    "Blur": (
        lambda depth: Blur.of(Mask(1, 1), OPTICS, depth),
        {"depth": 100.0},
    ),
    "SceneObject": (
        lambda **k: SceneObject("peg", **k),
        {"depth_um": 1.0, "depth_sigma_um": 1.0, "extent_px": 90.0, "features": 2, "place_sigma_px": 1.0},
    ),
    "Scene": (
        lambda **k: Scene((SceneObject("peg", 0.0),), **k),
        {"noise_grey": 1.3, "frame_rate_hz": 60.0, "shape": (400, 512), "tilt_deg": 30.0},
    ),
}


def wrong(good: Any) -> Iterator[Any]:
    """Yield what may come in place of a good argument."""
    if isinstance(good, float):
        yield from NUMBERS
    elif isinstance(good, int):
        yield from COUNTS
    elif isinstance(good, tuple):
        numbers = NUMBERS if isinstance(good[0], float) else COUNTS
        yield from ((number, good[1]) for number in numbers)
        yield from ((), good[:1], (*good, good[0]))
    elif isinstance(good, np.ndarray) and good.dtype == np.uint8:
        yield from (np.zeros_like(good), np.full_like(good, 255), good[:0], good[:-1], good.ravel())
        yield from (good.astype(kind) for kind in (np.float32, np.uint16, object, str))
    elif isinstance(good, np.ndarray):
        if good.dtype.kind in "fc":
            for number in NUMBERS:
                spoilt = good.copy()
                spoilt.flat[0] = number
                yield spoilt
                yield np.full_like(good, number)
            yield from (good * good.dtype.type(unit) for unit in (3e38, 1e20, 1e-20, 1e-40))
        else:
            yield from (np.full_like(good, 2**40), np.full_like(good, -5))
        yield from (good[:0], good.ravel(), good[None], good[:-1], good.astype(object), good.astype(str))


def is_finite(answer: Any) -> bool:
    if isinstance(answer, (float, complex, np.inexact)):
        return bool(np.isfinite(answer))
    if isinstance(answer, np.ndarray):
        return answer.dtype.kind not in "fc" or bool(np.isfinite(answer).all())
    if isinstance(answer, (list, tuple)):
        return all(is_finite(part) for part in answer)
    if dataclasses.is_dataclass(answer):
        return all(is_finite(getattr(answer, field.name)) for field in dataclasses.fields(answer))
    return True


def require_finite_or_refused(call: Call, good: dict[str, Any]) -> None:
    assert is_finite(call(**good))
    for name, value in good.items():
        for instead in wrong(value):
            try:
                answer = call(**{**good, name: instead})
            except AdofError:
                continue
            assert is_finite(answer), (name, instead, answer)


@pytest.mark.parametrize("name", HOST)
def test_the_host_answers_with_finite_numbers_or_refuses(name: str) -> None:
    require_finite_or_refused(*HOST[name])


@pytest.mark.parametrize("name", ON_DEVICE)
def test_a_plan_answers_with_finite_numbers_or_refuses(device: Device, name: str) -> None:
    call, good = ON_DEVICE[name]
    require_finite_or_refused(lambda **k: call(device, **k), good)


# ---- finite, but wrong: refused ---------------------------------------------------------------------------

SILENT: dict[str, Call] = {
    "half a sample of the stop": lambda: PupilGrid(2.5),  # type: ignore[arg-type]
    "half a row of a panel": lambda: SlmPanel("s", 2.5, 8, 8.0, 1.0, 60.0),  # type: ignore[arg-type]
    "a blur's width without a number": lambda: OPTICS.support_px(math.nan, 10),
    "a sampling check without a number": lambda: psf.require_sampling(64, math.nan, 1),
    "a panel of no stroke": lambda: slm_encode.stroke_table(0.0),
    "a panel of endless stroke": lambda: slm_encode.stroke_table(math.inf),
    "an OTF of one NaN": lambda: noise.noise_to_signal(
        np.ones(SHAPE), np.where(np.arange(11) == 3, np.nan, OTF), SHAPE
    ),
    "a frame larger than its padding": lambda: padding.padded_frame(np.ones((9, 9)), (8, 9)),
    "a padding of less than nothing": lambda: padding.padding_weights(-1, True),
    "a centre between pixels": lambda: wiener.psf_otf(
        np.ones((3, 3)),
        SHAPE,
        centre_yx=(0.5, 1),  # type: ignore[arg-type]
    ),
    "no centre at all": lambda: wiener.psf_otf(np.ones((3, 3)), SHAPE, centre_yx=()),  # type: ignore[arg-type]
    "noise below 0": lambda: tracking.Template.cut(GREY, (24, 24), (12, 12), noise=-1.0),
    "three gain limits": lambda: tracking.TrackingLimits(gain=(0.1, 10, 1)),  # type: ignore[arg-type]
    "a noise estimate from one NaN": lambda: tracking.estimate_noise(
        np.where(np.arange(52) == 3, np.inf, LEVELS)
    ),
    "a feature seen a million px wide": lambda: stereo.triangulate(
        RIG, np.ones(2), np.ones(2), np.diag([1e300, 0.01])
    ),
}


@pytest.mark.parametrize("what", SILENT)
def test_what_would_give_a_wrong_number_is_refused(what: str) -> None:
    with pytest.raises(InputError):
        SILENT[what]()


def test_contrast_is_the_same_for_both_signs_of_mask_and_defocus() -> None:
    wanted = MODEL.contrast(20, 10)
    assert wanted != MODEL.contrast(0, 10)
    for alpha, psi in ((-20, 10), (20, -10), (-20, -10)):
        assert MODEL.contrast(alpha, psi) == wanted


def test_a_gain_for_any_delay_is_what_eq_c7_says() -> None:
    for d in (0, 1, 2, 10, 100):
        exact = d**d / (d + 1) ** (d + 1)
        assert servo.gain_from_delay(d * 0.1, 0.1) == pytest.approx(exact / 0.1, rel=d * 3e-16 + 1e-15)


def test_a_tilt_or_a_phase_too_large_to_be_told_in_a_turn_is_refused(device: Device) -> None:
    plan = pupil_plan(device)
    for tilt in ((1e6, 0.0), (0.0, -1e300)):
        with pytest.raises(LimitError, match="tilt"):
            plan.evaluate(Mask(1, 1), tilt_xy_rad=tilt)
    with pytest.raises(LimitError, match="drop whole turns"):
        PupilPhase(device, 8, 8).set_odd(np.full(8, 1e7))


def test_a_stop_that_would_amplify_or_shift_light_is_refused(device: Device) -> None:
    for value in (-1.0, 1.5):
        stop = np.ones((32, 32))
        stop[3, 4] = value
        with pytest.raises(InputError, match="0 to 1"):
            psf.Psf(device, 32, stop=stop)


@pytest.mark.parametrize("score", ["ssd", "gain_offset"])
def test_a_template_whose_squares_leave_float32_is_refused_and_the_one_before_stays(
    device: Device, score: str
) -> None:
    plan = search_plan(device, score)
    plan.set_templates(CUT)
    before = plan.search(LEVELS)
    for factor in (3e38, 2 * LARGEST_LEVEL / float(CUT.max())):
        with pytest.raises(InputError, match="sum"):
            plan.set_templates(CUT * np.float32(factor))
    after = plan.search(LEVELS)
    assert (after.best_yx == before.best_yx).all()
    assert (after.score == before.score).all()
    bright = np.float32(LARGEST_LEVEL / float(LEVELS.max()) * 0.999)
    plan.set_templates(CUT * bright)
    assert plan.search(LEVELS * bright).best_yx.tolist() == [[10, 10]]


def test_contrast_too_faint_for_float32_is_no_match_rather_than_a_wrong_one(device: Device) -> None:
    plan = search_plan(device, "gain_offset")
    with pytest.raises(TrackingError, match="texture"):
        plan.set_templates(CUT * np.float32(1e-16))
    plan.set_templates(CUT)
    for factor in (1e-16, 1e-20, 1e-40):
        assert plan.search(LEVELS * np.float32(factor)).score[0] == 1
    faint = np.float32(1e-13)
    plan.set_templates(CUT * faint)
    found = plan.search(LEVELS * faint)
    assert found.best_yx.tolist() == [[10, 10]]
    assert found.score[0] < 1e-5


def test_a_dark_or_gain_map_beyond_float32_is_refused(device: Device) -> None:
    for maps in ({"dark": 1e300}, {"gain": 1e300}, {"dark": -1e20, "gain": 1e-3}):
        with pytest.raises(InputError, match="levels"):
            ImagePrep(device, SHAPE, **maps)


def test_a_full_scale_of_0_is_refused_not_taken_for_none(device: Device) -> None:
    with pytest.raises(InputError, match="full_scale"):
        tracking.TemplateTracker(device, GREY.shape, [TEMPLATE], (30, 30), full_scale=0.0)


def test_a_number_of_samples_with_another_prime_is_refused() -> None:
    with pytest.raises(InputError, match="factors"):
        Passes.of(22)
    assert optics.PupilGrid(2).x.tolist() == [-0.5, 0.5]
