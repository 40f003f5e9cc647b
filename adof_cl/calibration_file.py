"""Calibration on disk: one JSON file that is refused unless it is whole, ours, and still passes the gates.

    {"format": "adof calibration", "schema_version": 1, "sha256": "...", "content": {...}}

The checksum is that of the content, written compactly with sorted keys. Loading builds the same objects as a
fresh calibration, so the same gates hold; nothing is ever defaulted.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from adof_cl.errors import CalibrationError, InputError
from adof_cl.files import whole_file
from adof_cl.stereo import AffineCamera, StereoRig

FORMAT = "adof calibration"
SCHEMA_VERSION = 1
_LARGEST_FILE_BYTES = 1_000_000

_Triple = tuple[float, float, float]
_Row8 = tuple[float, float, float, float, float, float, float, float]


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class _CameraRecord(_Record):
    camera_id: str = Field(max_length=200)
    lens_id: str = Field(max_length=200)
    matrix_px_per_um: tuple[_Triple, _Triple]
    centre_um: _Triple
    centre_px: tuple[float, float]
    covariance_px_um: tuple[_Row8, _Row8, _Row8, _Row8, _Row8, _Row8, _Row8, _Row8]
    work_volume_um: tuple[_Triple, _Triple]
    sigma_limit_um: float
    rms_px: float
    extent_um: _Triple
    points: int = Field(ge=0)


class _RigRecord(_Record):
    work_volume_um: tuple[_Triple, _Triple]
    sigma_z_limit_um: float


class _Content(_Record):
    cameras: list[_CameraRecord] = Field(min_length=1, max_length=2)
    rig: _RigRecord | None


class _File(_Record):
    format: Literal["adof calibration"]
    schema_version: Literal[1]
    sha256: str
    content: dict[str, Any]


def _camera_record(camera: AffineCamera) -> dict[str, Any]:
    return {
        "camera_id": camera.camera_id,
        "lens_id": camera.lens_id,
        "matrix_px_per_um": camera.matrix_px_per_um.tolist(),
        "centre_um": camera.centre_um.tolist(),
        "centre_px": camera.centre_px.tolist(),
        "covariance_px_um": camera.covariance.tolist(),
        "work_volume_um": camera.work_volume_um.tolist(),
        "sigma_limit_um": float(camera.sigma_limit_um),
        "rms_px": float(camera.rms_px),
        "extent_um": camera.extent_um.tolist(),
        "points": int(camera.points),
    }


def _camera(path: Path, record: _CameraRecord) -> AffineCamera:
    try:
        return _camera_of(record)
    except InputError as error:
        raise CalibrationError(f"{path} is not a valid calibration ({error})") from error


def _camera_of(record: _CameraRecord) -> AffineCamera:
    return AffineCamera(
        matrix_px_per_um=np.array(record.matrix_px_per_um),
        centre_um=np.array(record.centre_um),
        centre_px=np.array(record.centre_px),
        covariance=np.array(record.covariance_px_um),
        work_volume_um=np.array(record.work_volume_um),
        sigma_limit_um=record.sigma_limit_um,
        rms_px=record.rms_px,
        extent_um=np.array(record.extent_um),
        points=record.points,
        camera_id=record.camera_id,
        lens_id=record.lens_id,
    )


def _checksum(content: object) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def save_calibration(path: Path, calibration: StereoRig | AffineCamera) -> None:
    """Write a pair or a single camera; the file appears whole or not at all.

    Raises
    ------
    InputError
        The place cannot be written.
    """
    if isinstance(calibration, StereoRig):
        cameras = [calibration.camera_1, calibration.camera_2]
        rig: dict[str, Any] | None = {
            "work_volume_um": calibration.volume_um.tolist(),
            "sigma_z_limit_um": float(calibration.sigma_z_limit_um),
        }
    else:
        cameras, rig = [calibration], None
    content = {"cameras": [_camera_record(camera) for camera in cameras], "rig": rig}
    record = {
        "format": FORMAT,
        "schema_version": SCHEMA_VERSION,
        "sha256": _checksum(content),
        "content": content,
    }
    with whole_file(Path(path)) as temporary:
        temporary.write_text(json.dumps(record, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _refuse_constant(name: str) -> float:
    raise ValueError(f"it holds {name}")


def _first_fault(error: ValidationError) -> str:
    fault = error.errors()[0]
    where = ".".join(str(part) for part in fault["loc"]) or "the whole"
    return f"{where}: {fault['msg']}"


def _read(path: Path) -> _Content:
    again = "calibrate again, or name the right file"
    try:
        size = path.stat().st_size
        if size > _LARGEST_FILE_BYTES:
            raise CalibrationError(f"{path} is {size} bytes, too large for a calibration: {again}")
        raw = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}): name a calibration file") from error
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path} is not a calibration file ({error}): {again}") from error
    if not isinstance(raw, dict) or raw.get("format") != FORMAT:
        raise CalibrationError(f"{path} is not a calibration file of this program: {again}")
    if raw.get("schema_version") != SCHEMA_VERSION:
        raise CalibrationError(
            f"{path} has schema version {raw.get('schema_version')!r:.20}, not {SCHEMA_VERSION}: {again}"
        )
    try:
        file = _File.model_validate_json(json.dumps(raw))
        found = _checksum(file.content)
        if found != file.sha256:
            raise CalibrationError(
                f"{path} was changed or damaged (checksum {found[:12]}, {file.sha256[:12]} noted): {again}"
            )
        return _Content.model_validate_json(json.dumps(file.content))
    except ValidationError as error:
        raise CalibrationError(
            f"{path} is not a valid calibration ({_first_fault(error)}): {again}"
        ) from error


def _require_ids(path: Path, cameras: list[AffineCamera], wanted: tuple[str, ...] | None, kind: str) -> None:
    found = tuple(getattr(camera, f"{kind}_id") for camera in cameras)
    if wanted is not None and found != tuple(wanted):
        raise CalibrationError(
            f"{path} belongs to the {kind} {' and '.join(map(repr, found))}, but "
            f"{' and '.join(map(repr, wanted))} is in use: calibrate this one"
        )


def load_camera(path: Path, *, camera_id: str | None = None, lens_id: str | None = None) -> AffineCamera:
    """Read a single camera, refusing another device's file.

    Raises
    ------
    InputError
        The file cannot be read.
    CalibrationError
        Corrupt, foreign, of another version, of another device, or no longer within its gate.
    """
    path = Path(path)
    content = _read(path)
    if len(content.cameras) != 1:
        raise CalibrationError(f"{path} holds a pair of cameras, where one was wanted: load it as a rig")
    camera = _camera(path, content.cameras[0])
    _require_ids(path, [camera], None if camera_id is None else (camera_id,), "camera")
    _require_ids(path, [camera], None if lens_id is None else (lens_id,), "lens")
    return camera


def load_rig(
    path: Path,
    *,
    camera_ids: tuple[str, str] | None = None,
    lens_ids: tuple[str, str] | None = None,
) -> StereoRig:
    """Read a calibrated pair, refusing another rig's file.

    Raises
    ------
    InputError
        The file cannot be read.
    CalibrationError
        Corrupt, foreign, of another version, of other devices, or no longer within the gates.
    """
    path = Path(path)
    content = _read(path)
    if content.rig is None or len(content.cameras) != 2:
        raise CalibrationError(f"{path} holds a single camera, where a pair was wanted: calibrate both")
    cameras = [_camera(path, record) for record in content.cameras]
    _require_ids(path, cameras, camera_ids, "camera")
    _require_ids(path, cameras, lens_ids, "lens")
    return StereoRig(
        cameras[0],
        cameras[1],
        work_volume_um=np.array(content.rig.work_volume_um),
        sigma_z_limit_um=content.rig.sigma_z_limit_um,
    )
