"""The house itself: one name in five places, headers complete, every citation there, no machine's paths."""

from __future__ import annotations

import itertools
import re
import subprocess
import tomllib
from pathlib import Path

import pytest

import cases
from adof_cl import reference
from adof_cl.device import Device
from adof_cl.program import Program

TREE = Path(__file__).parents[1]
OPERATIONS = (
    "pupil_phase",
    "slm_encode",
    "otf",
    "psf",
    "wiener",
    "restore",
    "image_prep",
    "ssd_search",
)

every_kernel_file = pytest.mark.parametrize(
    "path", sorted((TREE / "kernels").glob("*.cl")), ids=lambda path: path.name
)


def operation_of(path: Path) -> str:
    return next(op for op in OPERATIONS if path.stem == op or path.stem.startswith(f"{op}_"))


@pytest.mark.parametrize("operation", OPERATIONS)
def test_every_operation_has_its_name_in_five_places(operation: str) -> None:
    kernel = list((TREE / "kernels").glob(f"{operation}*.cl"))
    plan = TREE / "adof_cl" / f"{operation}.py"
    in_reference = [name for name in dir(reference) if name.startswith(operation)]
    test = TREE / "tests" / f"test_{operation}.py"
    case = [name for name in cases.CASES if name.startswith(operation)]
    missing = [
        place
        for place, there in (
            ("kernels/*.cl", kernel),
            ("plan", plan.is_file()),
            ("reference function", in_reference),
            ("test file", test.is_file()),
            ("case", case),
        )
        if not there
    ]
    assert not missing, f"{operation} is missing: {missing}"


def test_every_kernel_file_belongs_to_an_operation() -> None:
    strays = [
        path.name
        for path in (TREE / "kernels").glob("*.cl")
        if not any(path.stem == op or path.stem.startswith(f"{op}_") for op in OPERATIONS)
    ]
    assert not strays


def kernels_of(text: str) -> dict[str, list[str]]:
    """Every kernel function of a source, and its arguments."""
    found = re.findall(r"__kernel[^;{]*?\b(\w+)\(\s*(__global[^{]*?)\)\s*\{", text)
    assert len(found) == len(re.findall(r"^__kernel\b", text, re.MULTILINE))
    kernels: dict[str, list[str]] = {}
    for name, arguments in found:
        bare = re.sub(r"//[^\n]*", "", arguments)
        kernels.setdefault(name, []).extend(re.findall(r"(\w+)\s*(?:,|$)", bare))
    return kernels


def header_of(text: str) -> str:
    lines = itertools.takewhile(lambda line: line.startswith("//"), text.splitlines())
    return "\n".join(line.removeprefix("//").strip() for line in lines)


@every_kernel_file
def test_every_kernel_starts_with_its_operations_name(path: Path) -> None:
    kernels = kernels_of(path.read_text())
    assert kernels
    assert all(name.startswith(operation_of(path)) for name in kernels), kernels


@every_kernel_file
def test_every_kernel_file_opens_with_its_purpose_its_formula_and_its_measured_error(path: Path) -> None:
    header = header_of(path.read_text())
    assert re.match(rf"{re.escape(path.name)} : \w[^\n]+\.", header), "no purpose in the first line"
    assert re.search(r"docs/maths\.md, eqs?\. [A-Z]\d", header), "no numbered formula"
    assert re.search(r"work-item|work-group", header), "not said what one work-item does"
    assert re.search(r"[Ll]ocal memory", header), "not said how much local memory"
    assert re.search(r"[Bb]arrier", header), "not said what barriers"
    assert re.search(r"^Error: ", header, re.MULTILINE), "no measured error"


@every_kernel_file
def test_every_argument_of_a_kernel_is_in_its_files_header(path: Path) -> None:
    text = path.read_text()
    header = header_of(text)
    words = set(re.findall(r"\w+\*?", header))
    families = tuple(word.removesuffix("*") for word in words if word.endswith("_*"))
    absent = {
        (kernel, argument)
        for kernel, arguments in kernels_of(text).items()
        for argument in arguments
        if argument not in words and not (families and argument.startswith(families))
    }
    assert not absent


def equations_in(text: str) -> set[str]:
    """Numbers cited as "eq. O1", "eqs. O1, O4 and O5" or "eqs. W2 to W5", ranges written out."""
    cited = set()
    for run in re.findall(r"\beqs?\.\s+((?:[A-Z]\d+[a-z]?(?:,\s+|\s+and\s+|\s+to\s+)?)+)", text):
        cited.update(re.findall(r"[A-Z]\d+[a-z]?", run))
        for letter, first, last in re.findall(r"([A-Z])(\d+)\s+to\s+\1(\d+)", run):
            cited.update(f"{letter}{number}" for number in range(int(first), int(last) + 1))
    return cited


def test_ranges_and_lists_of_equations_are_read_in_full() -> None:
    text = "see eq. P1; docs/maths.md, eqs. W2 to W5; eqs. O1, O4\nand O11; the paper's eq. (3)"
    assert equations_in(text) == {"P1", "W2", "W3", "W4", "W5", "O1", "O4", "O11"}


def test_every_equation_a_source_cites_is_in_the_maths() -> None:
    numbered = set(re.findall(r"\(([A-Z]\d+[a-z]?)\)", (TREE / "docs" / "maths.md").read_text()))
    sources = [
        path
        for folder, pattern in (
            ("kernels", "*.cl"),
            ("kernels", "*.h"),
            ("adof_cl", "**/*.py"),
            ("tests", "*.py"),
            ("docs", "**/*.md"),
        )
        for path in (TREE / folder).glob(pattern)
        if path != Path(__file__)
    ]
    cited = {(path.name, number) for path in sources for number in equations_in(path.read_text())}
    assert len(cited) > 50
    assert {(name, number) for name, number in cited if number not in numbered} == set()


@pytest.mark.parametrize("path", sorted((TREE / "kernels").glob("*.h")), ids=lambda p: p.name)
def test_every_header_compiles_alone(path: Path, device: Device) -> None:
    source = f'#include "{path.name}"\n'
    Program(device, "otf.cl", {}, generated=(f"only_{path.name}", source))


@pytest.mark.parametrize(
    ("contract", "key", "free"),
    [
        (
            "the reference page is",
            "source_modules",
            {
                "cli",
                "twin",
                "selftest",
                "envelope",
                "bench",
                "bench_cases",
                "specimen",
                "tradeoff",
                "reference",
            },
        ),
        ("the twin shares nothing", "forbidden_modules", {"twin", "optics", "reference", "errors"}),
        ("only device and program", "source_modules", {"device", "program"}),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_an_import_contract_leaves_no_module_out(contract: str, key: str, free: set[str]) -> None:
    settings = tomllib.loads((TREE / "pyproject.toml").read_text())["tool"]["importlinter"]
    found = next(c for c in settings["contracts"] if c["name"].startswith(contract))
    listed = {name.removeprefix("adof_cl.") for name in found[key] if name.startswith("adof_cl.")}
    package = TREE / "adof_cl"
    modules = {path.stem for path in package.glob("*.py")} - {"__init__"}
    modules |= {path.parent.name for path in package.glob("*/__init__.py")}
    assert listed == modules - free, "bring the list in pyproject.toml up to date"


def test_no_path_of_one_machine_is_in_the_tree() -> None:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=TREE, capture_output=True, check=False)
    files = [TREE / name for name in listed.stdout.decode().split("\0") if name] or list(TREE.rglob("*"))
    text = {".py", ".md", ".cl", ".h", ".toml", ".yml", ".json", ""}
    pattern = re.compile(r"(?<![\w.])/(?:work|root|home)/[a-z.]")
    read = [path for path in files if path.suffix in text and path.is_file() and ".venv" not in path.parts]
    assert len(read) > 50
    assert [path for path in read if pattern.search(path.read_text(errors="replace"))] == []
