"""Configs: presets, JSON, use as static arguments, and validation."""

import json
import math
import re
from collections.abc import Iterator
from dataclasses import FrozenInstanceError, asdict, replace

import jax
import jax.numpy as jnp
import pytest

from ciassd_jax.config import (
    BackboneConfig,
    ClassConfig,
    Config,
    DetectionConfig,
    GridConfig,
    HeadConfig,
    LossConfig,
    NeckConfig,
    ScheduleConfig,
    StageConfig,
)
from ciassd_jax.config.json import RENAMED
from ciassd_jax.config.presets import PRESETS, car, car_lite, car_released, three_class, tiny

presets = pytest.mark.parametrize("make", list(PRESETS.values()), ids=list(PRESETS))


def fields(value: object, where: str = "") -> Iterator[tuple[str, object]]:
    """Every leaf of a config with its path."""
    if isinstance(value, dict):
        for name, item in value.items():
            yield from fields(item, f"{where}.{name}" if where else name)
    elif isinstance(value, list | tuple) and value and isinstance(value[0], dict):
        for i, item in enumerate(value):
            yield from fields(item, f"{where}[{i}]")
    else:
        yield where, value


def differences(config: Config, base: Config) -> dict[str, object]:
    """The leaves in which `config` departs from `base`."""
    before = dict(fields(asdict(base)))
    return {path: value for path, value in fields(asdict(config)) if (path, value) not in before.items()}


# Presets


def test_every_preset_is_listed_by_its_name():
    assert set(PRESETS) == {"car", "car_released", "car_lite", "three_class", "tiny"}
    assert [make() for make in (car, car_released, car_lite, three_class, tiny)] == [
        PRESETS[name]() for name in ("car", "car_released", "car_lite", "three_class", "tiny")
    ]


@presets
def test_presets_are_frozen_values(make):
    first, second = make(), make()
    assert first == second
    assert hash(first) == hash(second)
    others = [other() for other in PRESETS.values() if other is not make]
    assert all(first != other for other in others)
    with pytest.raises(FrozenInstanceError):
        first.dtype = "bfloat16"


def test_the_paper_preset():
    """The values of the paper (sections 3 and 4)."""
    config = car()
    assert config.grid.cells == (1408, 1600, 40)
    assert config.grid.shape == (41, 1600, 1408)
    shapes = [(41, 1600, 1408), (21, 800, 704), (11, 400, 352), (5, 200, 176), (2, 200, 176)]
    assert list(config.backbone.stage_shapes(config.grid.shape)) == shapes
    assert (config.bev_shape, config.bev_channels, config.backbone.stride) == ((200, 176), 128, 8)
    assert config.anchors_per_cell == 2
    assert config.class_names == ("Car",)
    expected = {
        "grid.overflow": "skip",
        "neck.kind": "ssfa",
        "neck.attention_kernel": 3,
        "head.angles": (0.0, math.pi / 2),
        "head.predict_iou": True,
        "head.iou_kernel": 1,
        "head.iou_bias": True,
        "classes[0].support_threshold": 2.6,
        "detection.nms": "paper",
        "detection.clamp_iou": True,
        "detection.score_threshold": 0.3,
        "detection.min_score": 0.0,
        "detection.max_candidates": 1000,
        "detection.nms_iou_threshold": 0.3,
        "detection.iou_exponent": 4.0,
        "detection.sigma_squared": (0.0009, 0.009, 0.1, 1.0),
        "detection.sigma_distances": (20.0, 40.0, 60.0),
        "detection.z_limits": (-5.0, 5.0),
    }
    leaves = dict(fields(asdict(config)))
    assert {path: leaves[path] for path in expected} == expected


def test_the_released_preset_departs_where_the_code_does():
    assert differences(car_released(), car()) == {
        "grid.overflow": "stop",
        "neck.attention_kernel": 1,
        "head.angles": (0.0, 1.57),
        "head.iou_kernel": 3,
        "head.iou_bias": False,
        "detection.nms": "released",
        "detection.clamp_iou": False,
    }


def test_three_classes_add_classes_only():
    config = three_class()
    assert all(path.startswith(("classes[1]", "classes[2]")) for path in differences(config, car()))
    rows = [(c.name, c.width, c.length, c.height, c.center_z) for c in config.classes]
    assert rows == [
        ("Car", 1.6, 3.9, 1.56, -1.0),
        ("Pedestrian", 0.6, 0.8, 1.73, -0.6),
        ("Cyclist", 0.6, 1.76, 1.73, -0.6),
    ]
    rows = [(c.matched, c.unmatched, c.support_threshold) for c in config.classes]
    assert rows == [(0.6, 0.45, 2.6), (0.5, 0.35, 1.0), (0.5, 0.35, 1.0)]
    assert config.anchors_per_cell == 6


@pytest.mark.parametrize("make", [car_lite, tiny])
def test_small_presets_keep_the_method(make):
    """They resize the grid and the network, with the support of a box, and leave the other rules and the head alone."""
    sizes = re.compile(
        r"grid\.|backbone\.|neck\.channels|detection\.max_candidates|data\.max_|classes\[0\]\.support_threshold"
    )
    changed = differences(make(), car())
    assert changed
    assert all(sizes.match(path) for path in changed), changed
    assert make().grid.overflow == car().grid.overflow


# JSON


@pytest.mark.smoke
@presets
def test_json_round_trip(make):
    config = make()
    again = Config.from_json(config.to_json())
    assert again == config
    assert hash(again) == hash(config)
    assert [type(value) for _, value in fields(asdict(again))] == [type(value) for _, value in fields(asdict(config))]


def test_whole_numbers_are_read_as_floats():
    text = json.dumps(asdict(car()) | {"detection": asdict(DetectionConfig()) | {"iou_exponent": 4}})
    config = Config.from_json(text)
    assert config == car()
    assert type(config.detection.iou_exponent) is float


def edited(path: str, value: object) -> str:
    """`car()` as JSON with one field replaced, or removed where `value` is `...`."""
    data = json.loads(car().to_json())
    *parents, last = path.split(".")
    section = data
    for name in parents:
        section = section[int(name)] if name.isdigit() else section[name]
    if value is ...:
        del section[last]
    else:
        section[last] = value
    return json.dumps(data)


@pytest.mark.parametrize(
    ("path", "value", "sentence"),
    [
        ("colour", 1, r"config: the field 'colour' is unknown; known are backbone, classes"),
        ("neck.chanels", 1, r"config\.neck: the field 'chanels' is unknown; did you mean 'channels'"),
        ("backbone.stages.1.channels", ..., r"config\.backbone\.stages\[1\]: the field 'channels' is missing"),
        ("backbone.stages.1.capacity", None, r"backbone\.stages\[1\]\.capacity is missing"),
        ("backbone.stages.1.capacity", 1.5, r"config\.backbone\.stages\[1\]\.capacity: expected int, not 1\.5"),
        (
            "backbone.stages.0.capacity",
            100,
            r"backbone\.stages\[0\]\.capacity: .* remove the 100 and set grid\.max_voxels",
        ),
        ("neck", 3, r"config\.neck: expected the fields \['attention_kernel', 'channels', 'kind'\]"),
        ("neck", None, r"config\.neck: expected the fields"),
        ("neck.channels", "128", r"config\.neck\.channels: expected int, not '128'"),
        ("neck.channels", 128.0, r"config\.neck\.channels: expected int, not 128\.0"),
        ("neck.channels", True, r"config\.neck\.channels: expected int, not True"),
        ("neck.channels", None, r"config\.neck\.channels: expected int, not None"),
        ("head.iou_bias", 1, r"config\.head\.iou_bias: expected bool, not 1"),
        ("detection.nms_iou_threshold", True, r"config\.detection\.nms_iou_threshold: expected float, not True"),
        ("detection.nms_iou_threshold", "0.3", r"config\.detection\.nms_iou_threshold: expected float, not '0\.3'"),
        ("grid.minimum", [0, -40], r"config\.grid\.minimum: expected 3 values, not 2"),
        ("grid.minimum", 0.0, r"config\.grid\.minimum: expected a list, not 0\.0"),
        ("grid.minimum", [0, -40, "low"], r"config\.grid\.minimum\[2\]: expected float, not 'low'"),
        ("classes", {}, r"config\.classes: expected a list, not \{\}"),
        ("classes.0.name", 5, r"config\.classes\[0\]\.name: expected str, not 5"),
        ("backbone.stages.1.layers", "two", r"config\.backbone\.stages\[1\]\.layers: expected int, not 'two'"),
        ("dtype", "float16", r"config\.dtype: 'float16' is not one of \['float32', 'bfloat16', 'float64'\]"),
        ("program", "tpu", r"config\.program: 'tpu' is not one of \['auto', 'cpu', 'accelerator'\]"),
        ("detection.nms", ["paper"], r"config\.detection\.nms: \['paper'\] is not one of"),
        # Equal to 1 and to 3 in Python, but no kernel sizes.
        ("neck.attention_kernel", True, r"config\.neck\.attention_kernel: True is not one of \[1, 3\]"),
        ("neck.attention_kernel", 3.0, r"config\.neck\.attention_kernel: 3\.0 is not one of \[1, 3\]"),
        ("detection.score_threshold", math.nan, r"detection\.score_threshold: nan is outside \[0, 1\)"),
        ("detection.max_candidates", 0, r"detection\.max_candidates must be at least 1"),
    ],
)
def test_json_with_a_wrong_field_is_refused(path, value, sentence):
    with pytest.raises(ValueError, match=sentence):
        Config.from_json(edited(path, value))


@pytest.mark.parametrize("text", ["", "{", "not json", "[1, 2"])
def test_text_that_is_not_json_is_refused(text):
    with pytest.raises(ValueError, match="config is not valid JSON"):
        Config.from_json(text)


@pytest.mark.parametrize("text", ["[]", "3", "null", '"car"'])
def test_json_that_is_not_a_config_is_refused(text):
    with pytest.raises(ValueError, match=r"config: expected the fields \['backbone', 'classes'"):
        Config.from_json(text)


@pytest.mark.parametrize("path", ["detection", "neck.channels", "schedule.remat", "dtype"])
def test_a_missing_field_has_its_default(path):
    assert Config.from_json(edited(path, ...)) == car()


def test_the_program_is_not_written_but_read():
    """It is a choice of the machine: weights and runs do not carry it to another."""
    config = replace(car(), program="cpu")
    assert Config.from_json(config.to_json()) == car()
    data = json.loads(config.to_json()) | {"program": "cpu"}
    assert Config.from_json(json.dumps(data)) == config


def with_old_names(config: Config) -> str:
    """The config as the version before the renames wrote it."""
    data = json.loads(config.to_json())
    sections = {
        "AugmentationConfig": [data["data"]["augmentation"]],
        "DataConfig": [data["data"]],
        "ClassConfig": data["classes"],
        "DetectionConfig": [data["detection"]],
        "ScheduleConfig": [data["schedule"]],
    }
    assert sections.keys() == RENAMED.keys()
    for kind, names in RENAMED.items():
        for section in sections[kind]:
            for old, new in names.items():
                section[old] = section.pop(new)
    data["backbone"]["stages"][0]["capacity"] = data["grid"]["max_voxels"]
    return json.dumps(data)


@presets
def test_json_with_the_names_of_earlier_versions_is_read(make):
    schedule = ScheduleConfig(gradient_accumulation_steps=3, remat=True, b1_range=(0.9, 0.8), b2=0.9, div_factor=5.0)
    config = replace(make(), schedule=schedule, detection=replace(make().detection, nms_iou_threshold=0.4))
    assert Config.from_json(with_old_names(config)) == config


def test_json_with_an_old_and_a_new_name_of_one_field_is_refused():
    data = json.loads(car().to_json())
    data["detection"]["nms_overlap"] = 0.3
    with pytest.raises(ValueError, match=r"'nms_overlap' is the old name of 'nms_iou_threshold'; remove one"):
        Config.from_json(json.dumps(data))


# Static arguments


def test_for_inference_keeps_what_predict_reads():
    config = three_class()
    other = replace(
        config,
        classes=tuple(replace(one, matched=0.9, similar=("Van",), gt_sampling_up_to=7) for one in config.classes),
        schedule=ScheduleConfig(learning_rate=1.0),
        loss=LossConfig(box_weight=1.0),
    )
    assert other != config
    assert other.for_inference() == config.for_inference()
    for changed in (
        replace(config, detection=replace(config.detection, score_threshold=0.5)),
        replace(config, detection=replace(config.detection, min_score=0.5)),
        replace(config, classes=(replace(config.classes[0], support_threshold=1.0), *config.classes[1:])),
        replace(config, classes=(replace(config.classes[0], center_z=0.0), *config.classes[1:])),
        replace(config, grid=replace(config.grid, max_voxels=30000)),
        replace(config, dtype="bfloat16"),
        replace(config, program="accelerator"),
    ):
        assert changed.for_inference() != config.for_inference()


@pytest.mark.smoke
def test_a_config_needs_no_static_argnames():
    traced = []

    @jax.jit
    def scale(x: jax.Array, config: Config) -> jax.Array:
        traced.append(config)
        return x * config.grid.max_voxels

    for config in (tiny(), tiny(), replace(tiny(), grid=replace(tiny().grid, max_voxels=7))):
        assert scale(jnp.ones(()), config) == config.grid.max_voxels
    assert len(traced) == 2


# Validation


@pytest.mark.parametrize(
    ("kind", "given", "sentence"),
    [
        (
            GridConfig,
            {"maximum": (0.0, 40.0, 1.0)},
            r"grid.minimum to grid.maximum along x: .* the maximum must exceed the minimum",
        ),
        (
            GridConfig,
            {"maximum": (70.4, -41.0, 1.0)},
            r"grid.minimum to grid.maximum along y: range -40\.0\.\.-41\.0 with voxel size 0\.05 is empty",
        ),
        (GridConfig, {"voxel_size": (0.05, 0.05, 0.0)}, r"along z: .*voxel size positive"),
        (GridConfig, {"voxel_size": (0.05, -0.05, 0.1)}, r"along y: .*voxel size positive"),
        (GridConfig, {"maximum": (math.inf, 40.0, 1.0)}, r"along x: .*both be finite"),
        (GridConfig, {"minimum": (0.0, -40.0, math.nan)}, r"along z: .*both be finite"),
        (
            GridConfig,
            {"maximum": (70.42, 40.0, 1.0)},
            r"grid\.maximum along x: 70\.42 m is 1408\.400 voxels .*maximum is 70\.4\.",
        ),
        (
            GridConfig,
            {"voxel_size": (0.05, 0.05, 0.3)},
            r"grid\.maximum along z: 4 m is 13\.333 voxels of 0\.3 m.*maximum is 0\.9\.",
        ),
        (GridConfig, {"max_voxels": 0}, "max_points_per_voxel and max_voxels must be at least 1"),
        (GridConfig, {"max_points_per_voxel": 0}, "max_points_per_voxel and max_voxels must be at least 1"),
        (GridConfig, {"overflow": "wrap"}, "grid: overflow 'wrap' is unknown; choose 'skip' or 'stop'"),
        (GridConfig, {"voxel_size": (0.01, 0.01, 0.01)}, "grid: 401 x 8000 x 7040 voxels .*use larger voxels"),
        (StageConfig, {"channels": 0, "layers": 1, "capacity": 1}, "backbone stage .*channels and capacity must be"),
        (StageConfig, {"channels": 1, "layers": -1, "capacity": 1}, "backbone stage .*layers at least 0"),
        (StageConfig, {"channels": 1, "layers": 1, "capacity": 0}, "backbone stage .*capacity must be at least 1"),
        (StageConfig, {"channels": 1, "layers": 1, "capacity": 1, "z_padding": 2}, "backbone stage .*z_padding 0 or 1"),
        (BackboneConfig, {"stages": ()}, "backbone: give at least one stage"),
        (BackboneConfig, {"backend": "cuda"}, "backbone: backend 'cuda' is unknown; choose 'gather' or 'dense'"),
        (NeckConfig, {"kind": "fpn"}, "neck.kind: 'fpn' is unknown; choose 'ssfa', 'second' or 'sassd'"),
        (NeckConfig, {"channels": 0}, "neck .*channels must be at least 1"),
        (NeckConfig, {"attention_kernel": 2}, "neck .*attention_kernel 1 or 3"),
        (ClassConfig, {"name": "Bus", "width": 0.0}, "class Bus: width, length and height must be positive"),
        (ClassConfig, {"length": -1.0}, "class Car: width, length and height must be positive"),
        (ClassConfig, {"height": 0.0}, "class Car: width, length and height must be positive"),
        (ClassConfig, {"matched": 0.4}, "class Car: thresholds must satisfy 0 < unmatched <= matched <= 1"),
        (ClassConfig, {"unmatched": 0.0}, "class Car: thresholds must satisfy"),
        (ClassConfig, {"matched": 1.1}, "class Car: thresholds must satisfy"),
        (HeadConfig, {"angles": ()}, "head .*at least one angle"),
        (HeadConfig, {"iou_kernel": 5}, "head .*iou_kernel must be 1 or 3"),
        (LossConfig, {"box_weight": -1.0}, r"loss\.box_weight: -1\.0 must be at least 0 and finite"),
        (LossConfig, {"direction_weight": math.nan}, r"loss\.direction_weight: nan must be"),
        (LossConfig, {"iou_weight": math.inf}, r"loss\.iou_weight: inf must be"),
        (LossConfig, {"focal_gamma": -0.5}, r"loss\.focal_gamma: -0\.5 must be"),
        (LossConfig, {"focal_alpha": 1.5}, r"loss\.focal_alpha: 1\.5 is outside \[0, 1\]"),
        (LossConfig, {"smooth_l1_sigma": 0.0}, r"loss\.smooth_l1_sigma: 0\.0 must be positive and finite"),
        (DetectionConfig, {"score_threshold": 1.0}, r"detection\.score_threshold: 1\.0 is outside \[0, 1\)"),
        (DetectionConfig, {"score_threshold": -0.1}, r"detection\.score_threshold: -0\.1 is outside"),
        (DetectionConfig, {"min_score": 1.0}, r"detection\.min_score: 1\.0 is outside \[0, 1\)"),
        (DetectionConfig, {"min_score": math.nan}, r"detection\.min_score: nan is outside \[0, 1\)"),
        (DetectionConfig, {"max_candidates": 0}, r"detection\.max_candidates must be at least 1"),
        (DetectionConfig, {"nms": "soft"}, r"detection\.nms: 'soft' .* choose 'paper', 'released' or 'rotated'"),
        (DetectionConfig, {"sigma_squared": (0.1, 0.0, 0.1, 1.0)}, "detection: sigma_squared must be positive"),
        (DetectionConfig, {"sigma_distances": (20.0, 60.0, 40.0)}, "detection: .*sigma_distances ascending"),
        (Config, {"classes": ()}, "classes: give at least one"),
        (Config, {"classes": (ClassConfig(), ClassConfig())}, "classes: .*each with its own name"),
        (Config, {"dtype": "float16"}, "dtype: 'float16' is unknown; choose 'float32', 'bfloat16' or 'float64'"),
        (Config, {"program": "gpu"}, "program: 'gpu' is unknown; choose 'auto', 'cpu' or 'accelerator'"),
        (
            Config,
            {"grid": GridConfig(maximum=(70.0, 40.0, 1.0))},
            r"grid\.maximum along x: 1400 voxels .* 69\.6 or 70\.4\.",
        ),
        (
            Config,
            {"grid": GridConfig(maximum=(70.4, 39.8, 1.0))},
            r"grid\.maximum along y: 1596 voxels .* 39\.2 or 40\.",
        ),
        (
            Config,
            {"grid": GridConfig(maximum=(0.4, 40.0, 1.0))},
            r"grid\.maximum along x: 8 voxels .* maximum is 0\.8\.",
        ),
        (
            Config,
            {"grid": GridConfig(maximum=(70.4, 40.0, -1.0))},
            r"grid\.maximum along z: 20 voxels shrink to 21 -> 11 -> 6 -> 2",
        ),
    ],
)
@pytest.mark.usefixtures("no_type_checks")
def test_a_wrong_value_is_refused_with_the_remedy(kind, given, sentence):
    with pytest.raises(ValueError, match=sentence) as caught:
        kind(**given)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "given",
    [
        {"score_threshold": 0.0},
        {"max_candidates": 1},
        {"sigma_distances": (20.0, 20.0, 60.0)},
        {"nms": "rotated"},
    ],
)
def test_values_at_the_limit_are_accepted(given):
    config = DetectionConfig(**given)
    assert Config.from_json(replace(car(), detection=config).to_json()).detection == config


@pytest.mark.parametrize("wanted", [0.02, 0.03, 0.13, 7.77, 51.234, 70.42])
def test_the_proposed_maximum_is_valid(wanted):
    with pytest.raises(ValueError, match="nearest valid maximum") as caught:
        GridConfig(maximum=(wanted, 40.0, 1.0))
    proposed = float(str(caught.value).split()[-1].rstrip("."))
    assert abs(proposed - wanted) <= 0.05
    assert GridConfig(maximum=(proposed, 40.0, 1.0)).cells[0] >= 1


@pytest.mark.parametrize("cells", [8, 24, 1400, 1409])
def test_the_proposed_maxima_are_valid(cells):
    def reaching(maximum: float) -> Config:
        return replace(car(), grid=replace(car().grid, maximum=(maximum, 40.0, 1.0)))

    with pytest.raises(ValueError, match="nearest valid maximum is") as caught:
        reaching(cells * 0.05)
    proposed = [float(number) for number in re.findall(r"[\d.]*\d", str(caught.value).rsplit("is", 1)[1])]
    assert proposed
    assert all(abs(reaching(maximum).grid.cells[0] - cells) < 16 for maximum in proposed)
