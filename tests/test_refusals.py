"""What people get wrong is refused before a process starts, in one line that says what to do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from launch import run_directory
from launch.compose import choices_of, compose
from launch.jobs import Job, refused, run
from launch.named_input import with_named_input
from launch.output import Output
from launch.refusal import GraphError
from launch.specs import check_addresses
from launch.sweep import check_launcher
from tests.support.dataset_folders import write_image, write_photos, write_tum

CHOICES = choices_of("dataset")


@pytest.fixture
def said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """What the launcher says of a command line, given in a folder of its own."""
    monkeypatch.chdir(tmp_path)

    def refusal(*words: str) -> str:
        try:
            graph = compose([*with_named_input(words, CHOICES)])
            code = run(Job(OmegaConf.create(graph.resolved), [], {"dataset": "x"}, None))
        except GraphError as error:
            code = refused(error)
        errors = capfd.readouterr().err.splitlines()
        assert code == 2
        assert len(errors) == 1, errors
        assert errors[0].startswith("error: ")
        return errors[0]

    return refusal


def fill(folder: Path) -> None:
    """What lies around where a user stands."""
    (folder / "notes.mp4").write_text("no video")
    (folder / "empty").mkdir()
    (folder / "file").touch()
    write_photos(folder / "photos", 3)
    write_tum(folder / "walk", 3)
    for i in range(5):
        write_image(folder / "mixed" / f"{i}.png", 9, (48, 64) if i < 2 else (64, 48))
    (folder / "broken").mkdir()
    (folder / "broken" / "0.jpg").write_bytes(b"nothing")


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        (["wolk.mp4"], "there is no such file or folder here"),
        (["empty"], "empty: is an empty folder"),
        (["notes.mp4"], "OpenCV cannot open notes.mp4: no video, cut off before its index was written"),
        (["broken"], "no image could be read"),
        (["photso"], "(did you mean photos?)"),
        (["photos/photo1.png"], "one image makes no map; give the folder"),
        (["walk"], "does not tell which camera took it: set dataset.options.camera to one of freiburg1"),
        (
            ["dataset=video", "dataset.path=notes.mp4", "dataset.intrinsics=null"],
            "set dataset.intrinsics=[fx,fy,cx,cy]",
        ),
        (["mixed"], "3 of 5 images have another shape than the first, 0.png of 64x48: 2.png is 48x64"),
        (["photos", "output=file"], "output="),
        (["photos", "mapper.iteration=3"], "has no parameter 'iteration' (did you mean iterations?)"),
        (["photos", "maper=ges"], "no slot or key 'maper' (did you mean mapper?)"),
        (["photos", "tracker=droit"], "tracker has no choice 'droit' (did you mean droid?)"),
        (["photos", "dataset.options.fps=3"], "dataset.options.fps: there is no such key"),
        (["photos", "dataset.stride=0"], "stride >= 1"),
        (["photos", "dataset.start=7"], "no frame left: the sequence has 3"),
        (["photos", "dataset.intrinsics=[1,2,3]"], "intrinsics is [fx, fy, cx, cy] in pixels of the original image"),
        (["photos", "tracker=droid", "tracker.constants.stride=0"], "constants.stride=0: must be 1 or more"),
        (["photos", "mapper.iterations=many"], "mapper.iterations=many: must be int"),
        (["photos", "device=cuda:77"], "device=cuda:77: this machine has"),
        (["photos", "evaluator=of"], "evaluator has no choice 'of' (did you mean off?)"),
        (["photos", "video"], "photos and video: one input at a time"),
        (["photos", "dataset.path=x"], "the input is given twice"),
        (["77"], "camera 77: /dev/video77 does not exist"),
        (["photos", "mapper.cpu=[0,999]"], "mapper.cpu=[0, 999]: must be cores that this program may use, which are 0"),
        (["photos", "mapper.cpu=[]"], "mapper.cpu=[]: must be cores"),
        (["photos", "mapper.threads=0"], "mapper.threads=0: must be 1 or more"),
        (["photos", "viewer=viser", "viewer.threads=-2"], "viewer.threads=-2: must be 1 or more"),
        (
            ["photos", "dataset.best_effort=[Frames]"],
            "best_effort=Frames: no such message (did you mean Frame?)",
        ),
        (["photos", "transport=tcp", "port=65534"], "ports from there on, of 1 to 65535"),
        (["photos", f"output={'a' * 300}"], f"/{'a' * 300}: File name too long"),
        (["photos", "output=[2024]"], "output=[2024]: must be the name of a folder; write output=./NAME"),
        (["photos", "viewer"], "a parameter is written slot.parameter=value"),
    ],
)
def test_it_is_said_in_one_line(words: list[str], answer: str, tmp_path: Path, said: Callable[..., str]) -> None:
    fill(tmp_path)
    assert answer in said(*words)
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("output", ["photos", "./photos/../photos", "walk/../photos"])
def test_the_folder_that_is_read_is_no_output(output: str, tmp_path: Path, said: Callable[..., str]) -> None:
    fill(tmp_path)
    before = sorted((tmp_path / "photos").rglob("*"))
    assert "in it; give another output=DIR" in said("photos", f"output={output}")
    assert sorted((tmp_path / "photos").rglob("*")) == before


@pytest.mark.parametrize("name", ["transforms.json", "config.yaml", "cameras.json", "trajectory.txt", "checkpoint"])
def test_files_that_no_run_has_left_are_not_replaced(name: str, tmp_path: Path, said: Callable[..., str]) -> None:
    fill(tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / name).write_text("a user's")
    assert f"has {name}, which no run has left there" in said("photos", "output=mine")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == [name]
    assert (tmp_path / "mine" / name).read_text() == "a user's"


def test_a_run_does_not_move_what_it_reads(tmp_path: Path, said: Callable[..., str]) -> None:
    fill(tmp_path)
    out = tmp_path / "out"
    out.mkdir()
    (out / "report.json").write_text('{"finished": true}')
    (tmp_path / "photos").rename(out / "keyframes")
    assert "in it; give another output=DIR" in said("out/keyframes", "output=out")
    assert (out / "keyframes").is_dir()


@pytest.mark.parametrize("words", [["host=0.0.0.0"], ["keys=nowhere"], ["port=0"]])
def test_what_is_refused_leaves_the_results_that_are_there(
    words: list[str], tmp_path: Path, said: Callable[..., str]
) -> None:
    fill(tmp_path)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "map.ply").touch()
    said("photos", "transport=tcp", "output=out", *words)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["map.ply"]


def test_a_socket_path_that_is_too_long_leaves_the_results_too(
    tmp_path: Path, said: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(tmp_path)
    monkeypatch.setattr(run_directory, "IPC_PATH_BYTES", 20)
    assert "set TMPDIR to a shorter one" in said("photos", "output=out")
    assert not (tmp_path / "out").exists()
    run_directory.base_directory(compose(["transport=tcp", "port=1"]))  # has no such path


@pytest.mark.parametrize("host", ["127.0.0.2", "[::1]", "localhost"])
def test_any_address_of_this_machine_alone_needs_no_keys(host: str) -> None:
    check_addresses(compose(["transport=tcp", f"host='{host}'"]))


@pytest.mark.parametrize("name", ["2024", "2024_01_01", "true", "1.50"])
def test_a_folder_may_be_named_like_a_number(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert compose([f"output={name}"]).settings.output == str(tmp_path / name)


def test_an_output_in_use_is_refused(tmp_path: Path, said: Callable[..., str]) -> None:
    fill(tmp_path)
    held = Output(tmp_path / "out")
    try:
        assert "another run" in said("photos", f"output={tmp_path / 'out'}")
    finally:
        held.release()


def test_a_few_images_of_another_shape_are_left_out_and_no_reason_to_refuse(tmp_path: Path) -> None:
    from mvsgs_core.datasets import check

    fill(tmp_path)
    for i in range(5, 10):
        write_image(tmp_path / "mixed" / f"{i}.png", 9, (48, 64))
    check("images", path=tmp_path / "mixed")


def test_a_refinement_on_ray_needs_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    graph = compose(["refine=ray", "refine.address=10.0.0.1:6379"])
    config = graph.slots["mapper"].parameters
    assert (config.refine.by, config.refine.address) == ("ray", "10.0.0.1:6379")
    with pytest.raises(ValueError, match=r"pip install 'ray>=2\.40'"):
        graph.slots["mapper"].node.check(config)
    with pytest.raises(GraphError, match="must name the cluster"):
        compose(["refine=ray", "refine.address=auto"])
    with pytest.raises(GraphError, match="'here' or 'ray'"):
        compose(["refine=slurm"])


def test_a_sweep_on_slurm_needs_its_launcher(monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["-m", "hydra/launcher=submitit_slurm", "mapper.iterations=1,2"]
    monkeypatch.setattr("launch.sweep.importlib.util.find_spec", lambda name: None)
    with pytest.raises(GraphError, match=r"pip install 'hydra-submitit-launcher>=1\.2'"):
        check_launcher(words)
    monkeypatch.setattr("launch.sweep.importlib.util.find_spec", lambda name: name)
    monkeypatch.setattr("launch.sweep.shutil.which", lambda name: None)
    with pytest.raises(GraphError, match="srun is not on this machine"):
        check_launcher(words)
    check_launcher(["-m", "hydra/launcher=submitit_local", "mapper.iterations=1,2"])
    monkeypatch.setattr("launch.sweep.shutil.which", lambda name: name)
    check_launcher(words)
    check_launcher(["-m", "mapper.iterations=1,2"])


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        (["dataset.size=240,320"], "dataset.size=240,320: a list is written dataset.size=[240,320], and a sweep over"),
        (["mapper.iterations=range(1,9)"], "mapper.iterations=range(1,9): a sweep over several values takes -m"),
        (["-m", "mapper.iterations=3,many"], "job 1 of the sweep: mapper.iterations=many: must be int"),
        (["-m", "dataset=images", "dataset.path=photos,nowhere"], "job 1 of the sweep: dataset: nowhere"),
    ],
)
def test_several_values_are_a_list_or_a_sweep_of_jobs_that_can_all_run(
    words: list[str], answer: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from launch.run_all import hydra_arguments  # which puts the path in order

    fill(tmp_path)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(GraphError) as refusal:
        hydra_arguments(words)
    assert str(refusal.value).startswith(answer)
    hydra_arguments(["-m", "hydra/launcher=submitit_local", "mapper.iterations=3,many"])  # is for others to say
    hydra_arguments(["dataset.size=[240,320]"])


@pytest.mark.parametrize(
    ("choice", "weights", "answer"),
    [
        ("mvs=itermvs", "mvs", "mvs: no weights of IterMVS"),
        ("tracker=droid", "tracker", "tracker: no weights of DROID-SLAM (droid.pth) in"),
        ("depth_fusion=vfuse", "depth_fusion", "depth_fusion: no weights of V-FUSE"),
    ],
)
def test_a_network_needs_its_weights(
    choice: str, weights: str, answer: str, tmp_path: Path, said: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(tmp_path)
    monkeypatch.delenv("MVSGS_WEIGHTS", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert answer in said("photos", choice)
    assert f"{weights}: weights of " in said("photos", choice, f"{weights}.weights=nothing.pth")
    torch.save({"a": torch.zeros(1)}, tmp_path / "other.pth")
    assert f"{weights}: other.pth does not fit " in said("photos", choice, f"{weights}.weights=other.pth")
    (tmp_path / "page.pth").write_text("<!DOCTYPE html>")
    assert f"{weights}: page.pth is a web page" in said("photos", choice, f"{weights}.weights=page.pth")
    slot = compose([choice, f"{weights}.weights=random"]).slots[weights]
    slot.node.check(slot.parameters)
