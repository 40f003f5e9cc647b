"""What the emulated GigE camera offers, as the GenICam description a client downloads from it."""

from __future__ import annotations

XML_ADDRESS = 0x20000
WIDTH, HEIGHT, OFFSET_X, OFFSET_Y = 0x10000, 0x10004, 0x10008, 0x1000C
PIXEL_FORMAT, PAYLOAD_SIZE, SENSOR_WIDTH, SENSOR_HEIGHT = 0x10010, 0x10014, 0x10018, 0x1001C
START, STOP, TRIGGER_MODE, TRIGGER_SOFTWARE = 0x10020, 0x10024, 0x10028, 0x1002C
EXPOSURE_US, FRAME_RATE_HZ, LINE_PADDING = 0x10030, 0x10034, 0x10038

PIXEL_FORMATS = {
    "Mono8": (0x01080001, 8),
    "Mono10": (0x01100003, 10),
    "Mono12": (0x01100005, 12),
    "Mono16": (0x01100007, 16),
    "Mono10p": (0x010A0046, 10),
    "Mono12p": (0x010C0047, 12),
    "Mono12Packed": (0x010C0006, 12),
}
"""By name in the Pixel Format Naming Convention: the code, and how many bits are pixel."""


def _register(name: str, address: int, access: str = "RO") -> str:
    return (
        f'<IntReg Name="{name}"><Address>0x{address:X}</Address><Length>4</Length>'
        f"<AccessMode>{access}</AccessMode><pPort>Device</pPort>"
        "<Cachable>NoCache</Cachable><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>"
    )


def _integer(name: str, address: int, access: str = "RO", limits: str = "") -> str:
    return f'<Integer Name="{name}"><pValue>{name}Reg</pValue>{limits}</Integer>' + _register(
        f"{name}Reg", address, access
    )


def _float(name: str, address: int, unit: str, low: float, high: float) -> str:
    return (
        f'<Float Name="{name}"><pValue>{name}Reg</pValue><Min>{low}</Min><Max>{high}</Max>'
        f"<Unit>{unit}</Unit></Float>"
        f'<FloatReg Name="{name}Reg"><Address>0x{address:X}</Address><Length>4</Length>'
        "<AccessMode>RW</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>"
        "<Endianess>BigEndian</Endianess></FloatReg>"
    )


def _choice(name: str, entries: dict[str, int], address: int | None = None) -> str:
    """An enumeration; without an address it has the one value it lists."""
    listed = "".join(
        f'<EnumEntry Name="{entry}"><Value>{value}</Value></EnumEntry>' for entry, value in entries.items()
    )
    if address is None:
        return (
            f'<Enumeration Name="{name}">{listed}<Value>{next(iter(entries.values()))}</Value></Enumeration>'
        )
    access = "RO" if name == "PixelFormat" else "RW"
    return f'<Enumeration Name="{name}">{listed}<pValue>{name}Reg</pValue></Enumeration>' + _register(
        f"{name}Reg", address, access
    )


def _command(name: str, address: int) -> str:
    return (
        f'<Command Name="{name}"><pValue>{name}Reg</pValue><CommandValue>1</CommandValue></Command>'
        + _register(f"{name}Reg", address, "WO")
    )


def _text(name: str, address: int, length: int) -> str:
    return (
        f'<StringReg Name="{name}"><Address>0x{address:X}</Address><Length>{length}</Length>'
        "<AccessMode>RO</AccessMode><pPort>Device</pPort></StringReg>"
    )


def description(pixel_format: str) -> str:
    """Return the XML; names as in the Standard Features Naming Convention."""
    features = {
        "DeviceVendorName": _text("DeviceVendorName", 0x48, 32),
        "DeviceModelName": _text("DeviceModelName", 0x68, 32),
        "DeviceVersion": _text("DeviceVersion", 0x88, 32),
        "DeviceSerialNumber": _text("DeviceSerialNumber", 0xD8, 16),
        "SensorWidth": _integer("SensorWidth", SENSOR_WIDTH),
        "SensorHeight": _integer("SensorHeight", SENSOR_HEIGHT),
        "Width": _integer("Width", WIDTH, "RW", "<Min>1</Min><pMax>SensorWidth</pMax>"),
        "Height": _integer("Height", HEIGHT, "RW", "<Min>1</Min><pMax>SensorHeight</pMax>"),
        "OffsetX": _integer("OffsetX", OFFSET_X, "RW", "<Min>0</Min><pMax>SensorWidth</pMax>"),
        "OffsetY": _integer("OffsetY", OFFSET_Y, "RW", "<Min>0</Min><pMax>SensorHeight</pMax>"),
        "PixelFormat": _choice("PixelFormat", {pixel_format: PIXEL_FORMATS[pixel_format][0]}, PIXEL_FORMAT),
        "PayloadSize": _integer("PayloadSize", PAYLOAD_SIZE),
        "ExposureTime": _float("ExposureTime", EXPOSURE_US, "us", 1, 1e7),
        "AcquisitionFrameRate": _float("AcquisitionFrameRate", FRAME_RATE_HZ, "Hz", 0.1, 1000),
        "AcquisitionMode": _choice("AcquisitionMode", {"Continuous": 0}),
        "AcquisitionStart": _command("AcquisitionStart", START),
        "AcquisitionStop": _command("AcquisitionStop", STOP),
        "TriggerSelector": _choice("TriggerSelector", {"FrameStart": 0}),
        "TriggerSource": _choice("TriggerSource", {"Software": 0}),
        "TriggerMode": _choice("TriggerMode", {"Off": 0, "On": 1}, TRIGGER_MODE),
        "TriggerSoftware": _command("TriggerSoftware", TRIGGER_SOFTWARE),
        "TLParamsLocked": '<Integer Name="TLParamsLocked"><Value>0</Value></Integer>',
        "GevHeartbeatTimeout": _integer("GevHeartbeatTimeout", 0x938, "RW"),
        "GevTimestampTickFrequency": '<IntReg Name="GevTimestampTickFrequency"><Address>0x93C</Address>'
        "<Length>8</Length><AccessMode>RO</AccessMode><pPort>Device</pPort>"
        "<Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>",
        "GevSCPSPacketSize": '<Integer Name="GevSCPSPacketSize"><pValue>GevSCPSPacketSizeReg</pValue>'
        "<Min>576</Min><Max>9000</Max></Integer>"
        '<MaskedIntReg Name="GevSCPSPacketSizeReg"><Address>0xD04</Address><Length>4</Length>'
        "<AccessMode>RW</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable><LSB>31</LSB><MSB>16</MSB>"
        "<Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></MaskedIntReg>",
        "GevSCPD": _integer("GevSCPD", 0xD08, "RW"),
    }
    names = "".join(f"<pFeature>{name}</pFeature>" for name in features)
    return (
        '<?xml version="1.0" encoding="utf-8"?>'
        '<RegisterDescription ModelName="EmulatedGigeCamera" VendorName="adof" ToolTip="" '
        'StandardNameSpace="GEV" SchemaMajorVersion="1" SchemaMinorVersion="1" SchemaSubMinorVersion="0" '
        'MajorVersion="1" MinorVersion="0" SubMinorVersion="0" '
        'ProductGuid="7f1cf5b6-5d2c-4ad0-9b8e-26e9d9a6a001" '
        'VersionGuid="7f1cf5b6-5d2c-4ad0-9b8e-26e9d9a6a002" '
        'xmlns="http://www.genicam.org/GenApi/Version_1_1">'
        f'<Category Name="Root" NameSpace="Standard">{names}</Category>'
        f"{''.join(features.values())}"
        '<Port Name="Device" NameSpace="Standard"/></RegisterDescription>'
    )
