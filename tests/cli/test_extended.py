"""Extended parameters on the command line, with a simulated camera behind the link."""

from __future__ import annotations

from pathlib import Path

from paramclient.sim import Air, Camera, PX4Vehicle
from tests.commands import Command, Put

CAMERA = ("--vehicle", "1/100", "--extended")


EXT_FILE = """{"paramclient": 1, "sets": [{"extended": true, "params": {
    "CAM_NAME": {"value": "Rear", "type": "CUSTOM"}, "CAM_KEY": {"value": "hex:01", "type": "CUSTOM"},
    "CAM_CLOCK": {"value": 4611686018427387907, "type": "INT64"}}}]}"""


def small() -> Camera:
    return Camera({"CAM_MODE": 1, "CAM_NAME": "Front", "CAM_KEY": b"\xff\0\xfe", "CAM_EV": 0.5})


def test_without_the_option_a_camera_gets_a_hint(command: Command, put: Put) -> None:
    done = command("get", put(small()), "A", "--vehicle", "1/100", "--timeout", 3)
    assert done.code in (1, 3)
    assert done.err.startswith("1/100 usually has extended parameters: --extended uses them\n")


def test_get_and_set(command: Command, put: Put) -> None:
    camera = small()
    url = put(camera)
    done = command(
        "set", url, *CAMERA, "CAM_NAME", "-Rear-", "CAM_MODE=0x10", "CAM_KEY", "hex:00ff", "CAM_EV", 1
    )
    assert (done.code, done.err) == (0, "1/100 camera: 4 accepted\n")
    assert done.rows[1:] == [
        ["CAM_NAME", "-Rear-", "-Rear-", "accepted"],
        ["CAM_MODE", "16", "16", "accepted"],
        ["CAM_KEY", "hex:00ff", "hex:00ff", "accepted"],
        ["CAM_EV", "1.0", "1.0", "accepted"],
    ]
    assert camera.ext_values == {"CAM_NAME": "-Rear-", "CAM_MODE": 16, "CAM_KEY": b"\0\xff", "CAM_EV": 1.0}
    found = command("get", url, "CAM_NAME", "NO_SUCH", *CAMERA)
    assert (found.code, found.words[1][:2]) == (2, ["CAM_NAME", "-Rear-"])
    assert "1/100 has no NO_SUCH" in found.err
    assert command("get", url, "CAM_N*", *CAMERA, "--json").json["params"]["CAM_NAME"]["value"] == "-Rear-"


def test_refusals_have_a_status_and_an_exit_code(command: Command, put: Put) -> None:
    url = put(Camera({"A": 1, "B": 2, "C": 3}, supported={"A": [1]}, failing=["B"], limits={"C": (0, 5)}))
    done = command("set", url, *CAMERA, "A", 2, "B", 5, "C", 9)
    assert done.code == 1
    assert [row[:3] for row in done.rows[1:3]] + done.rows[3:] == [
        ["A", "2", "refused"],
        ["B", "5", "refused"],
        ["C", "9", "5", "adjusted"],
    ]
    assert done.rows[1][3] == "1/100 refused A: value unsupported"
    assert command("set", url, *CAMERA, "A", 2, "--json").json["results"][0]["status"] == "refused"
    for words, why in (
        (("A", "text"), "A: 'text' is not a value of type INT32"),
        (("A", "hex:0g"), "is not a value of type INT32"),
        (("A", 2**40), "does not fit INT32"),
        (("A",), "A has no value"),
    ):
        failed = command("set", put(Camera({"A": 1})), *CAMERA, *words)  # its clock begins with the command's
        assert (failed.code, why in failed.err) == (2, True), failed.err


def test_files_and_comparisons(command: Command, put: Put, tmp_path: Path) -> None:
    camera = small()
    url = put(camera)
    file = tmp_path / "camera.json"
    saved = command("save", url, file, *CAMERA)
    assert (saved.code, saved.err) == (0, f"4 extended parameters of 1/100 written to {file} (json)\n")
    assert command("show", file).words[1][:2] == ["CAM_MODE", "1"]
    same = command("diff", file, url, "--vehicle", "1/100")
    assert (same.code, same.out) == (0, "")
    camera.set_ext_param("CAM_NAME", "Rear")
    camera.remove_ext_param("CAM_EV")
    other = command("diff", file, url, *CAMERA)
    assert other.code == 1
    assert other.rows[1:] == [["CAM_EV", "0.5", "only left"], ["CAM_NAME", "Front", "Rear", "different"]]
    refused = command("save", url, tmp_path / "camera.param", *CAMERA)
    assert (refused.code, "cannot hold extended parameters" in refused.err) == (2, True)


def test_apply_reports_what_it_cannot_do(command: Command, put: Put, tmp_path: Path) -> None:
    file = tmp_path / "camera.json"
    assert command("save", put(small()), file, *CAMERA).code == 0
    url = put(Camera({"CAM_MODE": 2, "CAM_NAME": 5}, supported={"CAM_MODE": [2]}))
    invalid = command("apply", url, file, *CAMERA)
    assert (invalid.code, "CAM_NAME: 'Front' is not a number" in invalid.err) == (2, True)
    done = command("apply", url, file, *CAMERA, "--partial")
    assert done.code == 2
    assert "4 refused" in done.err, done.err
    assert "not on this vehicle" in done.out
    wrong = command("apply", put(Camera(component=101)), file, "--vehicle", "1/101")
    assert (wrong.code, "no set matches (any system, component 101)" in wrong.err) == (2, True)
    plain = tmp_path / "plain.param"
    plain.write_text("CAM_MODE,5\n")
    kinds = command("apply", put(small()), plain, *CAMERA)
    assert (kinds.code, "are plain ones, and extended ones are needed" in kinds.err) == (2, True)


def test_restore_undoes_apply_from_the_cache_and_a_backup(command: Command, put: Put, tmp_path: Path) -> None:
    camera = Camera(
        {"CAM_NAME": "Front", "CAM_KEY": b"\xff\0\xfe", "CAM_CLOCK": (8, 2**62 + 1), "CAM_EV": 0.5}
    )
    before = camera.ext_values
    url = put(camera)
    assert command("restore", url, *CAMERA).code == 5
    file, backup = tmp_path / "camera.json", tmp_path / "before.json"
    file.write_text(EXT_FILE)
    assert command("apply", url, file, *CAMERA, "--backup", backup).code == 0
    changed = {"CAM_NAME": "Rear", "CAM_KEY": b"\1", "CAM_CLOCK": 2**62 + 3}
    assert camera.ext_values == before | changed
    [kept] = command("history", 1, "--extended", "--snapshots").rows[1:]
    assert (kept[0], kept[2:4], kept[-1]) == ("1", ["100", "4"], "before apply")
    restored = command("restore", url, *CAMERA)
    assert (restored.code, camera.ext_values) == (0, before), restored.err
    assert restored.rows[1] == ["CAM_NAME", "Rear", "Front", "Front", "accepted"]
    undone = command("restore", url, 2, *CAMERA)
    assert (undone.code, camera.ext_values) == (0, before | changed), undone.err
    assert (command("restore", url, backup, *CAMERA).code, camera.ext_values) == (0, before)


def test_cached_extended_parameters_are_shown_offline(command: Command, put: Put) -> None:
    url = put(Air.symmetric([PX4Vehicle(table={"A": 1}), small()]))
    assert command("fetch", url).code == 0
    assert command("fetch", url, *CAMERA).code == 0
    shown = command("show", "1/100", "--extended")
    assert shown.code == 0
    assert [row[0] for row in shown.rows[1:]] == ["CAM_MODE", "CAM_NAME", "CAM_KEY", "CAM_EV"]
    assert command("show", 1, "CAM_NAME", "--extended").rows[1][:3] == ["CAM_NAME", "Front", "CUSTOM"]
    [table] = command("show", 1, "--extended", "--json").json["components"]
    assert table["params"]["CAM_MODE"]["value"] == 1
    assert command("show", "1/1", "--extended").code == 5
    assert command("diff", 1, url, *CAMERA).code == 0


def test_all_are_those_that_have_some(command: Command, put: Put) -> None:
    url = put(Air.symmetric([PX4Vehicle(table={"A": 1}), small()]))
    fetched = command("fetch", url, "--vehicle", "all", "--extended", "--json")
    assert (fetched.code, [each["component"] for each in fetched.json["vehicles"]]) == (0, [100])
    assert fetched.err.startswith("1/1 PX4 quadrotor has no extended parameters, or none in 2.5 s\n")
    alone = command("fetch", put(small()), "--vehicle", "all", "--extended")
    assert alone.code == 0
    assert alone.err.startswith("4 extended parameters of 1/100 camera from stream ")
    none = command("fetch", put(PX4Vehicle(table={"A": 1})), "--vehicle", "all", "--extended")
    assert (none.code, "a component with extended parameters" in none.err) == (3, True)
