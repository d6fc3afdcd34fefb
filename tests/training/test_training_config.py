"""The configuration of a run and its command line: what is read, said, refused and compared."""

import dataclasses
import json
import math

import docstring_parser
import pytest
import torch
import yaml
from training_runs import losses, run_config

from lightfield_gs import InputError
from lightfield_gs.io.text_files import config_names, config_path
from lightfield_gs.models import ModelConfig
from training import train
from training.config import OptimizerConfig, Stage, TrainingConfig
from training.data.plan import Augmentation
from training.losses import LossWeights


def test_stages_count_steps_and_examples():
    config = TrainingConfig("out", ["data"], [Stage(10, 64, 8), Stage(5, 128, 4)])
    assert config.total_steps == 15
    assert config.stage_at(9) == (config.stages[0], 72)
    assert config.stage_at(12) == (config.stages[1], 88)
    with pytest.raises(IndexError):
        config.stage_at(15)


def test_stages_by_the_clock_follow_the_time():
    stages = [Stage(minutes=1, image_size_px=64, objects=8), Stage(minutes=0.5, image_size_px=128, objects=4)]
    config = TrainingConfig("out", ["data"], stages)
    assert config.stage_at(7, 59.9) == (stages[0], 56) and config.stage_at(7, 60.0) == (stages[1], 28)
    assert not config.is_over(10**6, 89.9) and config.is_over(0, 90.0)
    with pytest.raises(InputError, match="minutes for all stages or for none"):
        dataclasses.replace(config, stages=[*stages, Stage(3, 64, 8)])
    with pytest.raises(InputError, match="steps or minutes, got both"):
        Stage(3, 64, 8, minutes=1.0)


@pytest.mark.parametrize(
    "arguments, word",
    [
        (["--config", "none.yaml"], "none.yaml"),
        (["--seed", "x"], "seed"),
        (["--steps", "5"], "steps"),
        (["--stages", "[{steps: 5}]"], "stages"),
        (["--device", "gpu"], "device"),
    ],
)
def test_bad_arguments_are_reported_in_one_line(small_set, capsys, arguments, word):
    assert train.main(["--config", str(run_config(small_set, "unused")), *arguments]) == 2
    error = capsys.readouterr().err
    assert word in error and error.count("\n") == 1


def test_help_says_what_every_field_is(capsys):
    for owner in (TrainingConfig, OptimizerConfig, LossWeights, Augmentation, Stage):
        described = {entry.arg_name: entry.description for entry in docstring_parser.parse(owner.__doc__).params}
        assert list(described) == [field.name for field in dataclasses.fields(owner)] and all(described.values())
    with pytest.raises(SystemExit):
        train.main(["--help"])
    said = " ".join(capsys.readouterr().out.split())
    for words in (
        "the panel's full viewing cone, degrees",
        "last learning rate / peak",
        "of 1 - SSIM",
        "largest turn of the target cameras",
    ):
        assert words in said


@pytest.mark.parametrize(
    "error, words, code",
    [
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB."), "take fewer objects", 2),
        (OSError(28, "No space left on device"), "No space left", 2),
        (KeyboardInterrupt(), "interrupted", 130),
    ],
)
def test_what_ends_a_run_is_said_in_one_line(small_set, capsys, monkeypatch, error, words, code):
    monkeypatch.setattr(train, "train", lambda config: (_ for _ in ()).throw(error))
    assert train.main(["--config", str(run_config(small_set, "unused"))]) == code
    said = capsys.readouterr().err
    assert said.startswith("training.train: error: ") and words in said and said.count("\n") == 1


STAGE = {"steps": 2, "image_size_px": 16, "objects": 2}


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"stages": []}, "stages: expected at least one"),
        ({"data": []}, "data: expected at least one"),
        ({"output_dir": ""}, "output_dir: expected a folder"),
        ({"output_dir": __file__}, "cannot make the folder"),
        ({"cache_dir": __file__}, "cannot make the folder"),
        ({"validation": "nowhere"}, "nowhere: expected a folder of objects"),
        *[
            ({"stages": [STAGE | {field: value}]}, f"stages: {field}")
            for field, value in (
                ("steps", 0),
                ("steps", -3),
                ("image_size_px", 0),
                ("image_size_px", 15),
                ("objects", 0),
                ("target_px", -4),
            )
        ],
        *[
            ({field: value}, f"{field} must be")
            for field, value in (
                ("seed", -1),
                ("seed", 2**31),
                ("cone_deg", -5.0),
                ("cone_deg", math.nan),
                ("cone_margin", -1.0),
                ("elevation_deg", -1.0),
                ("neighbour_deg", math.inf),
                ("targets", 0),
                ("procedural", -0.1),
                ("procedural", 1.5),
                ("procedural", math.nan),
                ("checkpoint_every", 0),
                ("validate_every", 0),
                ("validation_objects", 0),
                ("threads", -1),
            )
        ],
        *[
            ({"optimizer": {field: value}}, f"optimizer.{field} must be")
            for field, value in (
                ("learning_rate", -1.0),
                ("learning_rate", math.nan),
                ("betas", [0.9, 1.0]),
                ("weight_decay", -1.0),
                ("warmup_steps", -1),
                ("final_share", 2.0),
                ("clip", 0.0),
                ("ema_decay", 2.0),
            )
        ],
        ({"loss": {"colour": math.inf}}, "loss.colour must be"),
        ({"loss": {"colour": 0, "ssim": 0, "alpha": 0}}, "loss: expected a weight above 0"),
        ({"augmentation": {"mirror": 1.5}}, "augmentation.mirror must be"),
        ({"augmentation": {"target_zoom": [0.0, 1.0]}}, "augmentation.target_zoom must be"),
        ({"augmentation": {"target_zoom": [2.0, 0.5]}}, "augmentation.target_zoom: expected the smaller number first"),
    ],
)
def test_numbers_out_of_range_are_refused_before_the_first_step(small_set, capsys, changes, words):
    assert train.main(["--config", str(run_config(small_set, "refused", **changes))]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("training.train: error: ") and words in error
    assert not losses(small_set / "refused")


def test_a_run_that_was_stored_before_a_field_existed_has_its_default():
    config = TrainingConfig("out", ["data"], [Stage(5, 16, 2)])
    stored = json.loads(json.dumps(config.identity()))
    del stored["symmetric"], stored["augmentation"]["noise"], stored["stages"][0]["minutes"]
    stored["detail"] = 0.0  # a field that was removed
    assert config.differences(stored) == []
    assert config.differences(stored | {"detail": 0.5}) == ["detail"]
    stored["augmentation"]["mirror"] = 0.25
    assert config.differences(stored | {"seed": 3}) == ["augmentation", "seed"]
    assert "stages" in config.differences(None) and "unet" in config.differences(stored | {"unet": {}})


def test_a_run_with_other_data_is_another_unless_the_folders_were_moved():
    config = TrainingConfig("out", ["data/cone"], [Stage(5, 16, 2)], target_data=["data/sphere"])
    stored = json.loads(json.dumps(config.identity()))
    moved = dataclasses.replace(config, data=["/elsewhere/cone/"], target_data=["sphere"])
    assert moved.differences(stored) == []
    other = dataclasses.replace(config, data=["data/sphere", "data/cone"], target_data=[])
    assert other.differences(stored) == ["data", "target_data"]
    del stored["data"], stored["target_data"]  # as they were stored before
    assert other.differences(stored) == []


SHIPPED = [
    name
    for name in config_names("training")
    if {"stages", "arms"} & yaml.safe_load(config_path("training", name).read_text()).keys() == {"stages"}
]  # others are comparisons, or of another network


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_configurations_can_be_read(name):
    config = train.read_config(["--config", str(config_path("training", name))])
    assert config.total_steps > 0 or config.by_time
    assert ModelConfig.from_yaml(config.model).image_size_px == config.stages[-1].image_size_px


def test_a_comparison_is_sent_to_its_own_command():
    with pytest.raises(InputError, match="several arms is for python -m training.compare"):
        train.read_config(["--config", str(config_path("training", "compare"))])
