"""Metadata files that the user adds: for which firmware each is used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from paramclient import FileError, ParamSet, UsageError
from paramclient.metadata import AddedFiles, Metadata, MetadataStore
from paramclient.model.identity import Identity
from paramclient.model.px4_hash import crc32_px4

DATA = Path(__file__).parent.parent / "data"
ARDUPILOT, PX4 = 3, 12
COPTER = Identity(1, "link", autopilot=ARDUPILOT, vehicle_type=2, firmware=0x04060100)
"""A copter with 4.6.1."""


def described(folder: Path, vehicle: str, maximum: int = 10) -> Path:
    """Write a metadata file that gives GAIN a range, and return its path."""
    path = folder / f"{vehicle}-{maximum}.xml"
    path.write_text(
        f'''<paramfile><vehicles><parameters name="{vehicle}"><param name="{vehicle}:GAIN" humanName="Gain"
        documentation="A gain"><field name="Range">0 {maximum}</field></param><param name="{vehicle}:MODE"
        humanName="Mode"><values><value code="2">Loiter</value></values></param></parameters></vehicles>
        </paramfile>'''
    )
    return path


def maximum(files: AddedFiles, identity: Identity, component: int = 1) -> float | None:
    return shown(files.find(identity, component))


def shown(found: Metadata | None) -> float | None:
    """Return the maximum by which it shows which file is used; None for no file."""
    return None if found is None else found["GAIN"].maximum


def test_the_most_exact_version_that_fits_is_used(tmp_path: Path) -> None:
    files = AddedFiles(tmp_path / "added")
    assert list(files) == []
    assert maximum(files, COPTER) is None
    files.add(described(tmp_path, "ArduCopter", 1))
    files.add(described(tmp_path, "ArduCopter", 46), firmware="4.6")
    files.add(described(tmp_path, "ArduCopter", 460), firmware="4.6.0")
    files.add(described(tmp_path, "ArduPlane", 3))
    assert ", ".join(map(str, files)) == "copter (any version), copter 4.6, copter 4.6.0, plane (any version)"
    assert maximum(files, COPTER) == 46
    assert maximum(files, replace(COPTER, firmware=0x040600FF)) == 460
    assert maximum(files, replace(COPTER, firmware=0x043C0000)) == 1, "4.60 is not 4.6"
    assert maximum(files, replace(COPTER, firmware=0)) == 1, "the version is not known"
    kinds = [replace(COPTER, vehicle_type=each) for each in (13, 1, 10)]
    assert [maximum(files, each) for each in kinds] == [46, 3, None], "a hexacopter, a plane, a rover"
    assert maximum(files, replace(COPTER, autopilot=PX4)) is None
    assert maximum(files, COPTER, component=100) is None, "a camera"


def test_a_file_must_be_metadata_of_a_known_vehicle(tmp_path: Path) -> None:
    files = AddedFiles(tmp_path / "added")
    with pytest.raises(UsageError, match="names no vehicle type"):
        files.add(DATA / "apm.pdef.xml")
    assert files.add(DATA / "apm.pdef.json", "rover")[0].kind == "rover"
    assert files.add(DATA / "parameters.json")[0].kind == "px4"
    with pytest.raises(UsageError, match=r"written as 4\.6"):
        files.add(DATA / "parameters.json", firmware="../4")
    with pytest.raises(FileError):
        files.add(DATA / "px4_flight.ulg", "px4")
    with pytest.raises(UsageError, match=r"added: px4 \(any version\), rover \(any version\)"):
        files.remove("copter")


def test_a_damaged_copy_is_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    files = AddedFiles(tmp_path / "added")
    added, _ = files.add(described(tmp_path, "ArduCopter"))
    added.path.write_text("<")
    assert files.find(COPTER, 1) is None
    assert "copter.added" in caplog.text


def test_a_store_prefers_what_the_vehicle_has_provided(tmp_path: Path) -> None:
    store = MetadataStore(tmp_path / "metadata")
    identity = replace(COPTER, git_hash="0badc0de")
    before = store.has_notes
    store.added.add(described(tmp_path, "ArduCopter", 7))
    assert (before, store.has_notes) == (False, True)
    own = described(tmp_path, "ArduCopter", 8).read_bytes()
    found = store.known(identity, 1)
    assert shown(found) == 7
    assert store.known(identity, 1) is found, "an unchanged file is parsed once"
    store.added.add(described(tmp_path, "ArduCopter", 9))
    assert shown(store.known(identity, 1)) == 9
    store.keep({crc32_px4(own): own}, identity, 1, crc32_px4(own))
    assert shown(store.known(identity, 1)) == 8


def test_only_a_set_without_identity_takes_the_metadata_of_another(tmp_path: Path) -> None:
    store = MetadataStore(tmp_path / "metadata")
    store.added.add(described(tmp_path, "ArduCopter", 7))
    sets = [ParamSet({}, identity=each) for each in (replace(COPTER, vehicle_type=10), COPTER, None)]
    assert [*map(shown, store.known_of_sets(sets))] == [None, 7, 7]
