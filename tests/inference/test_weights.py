"""Weights files: round trip, released files of every layout, and what is refused."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import safetensors
import safetensors.numpy
from released import LAYOUTS, State, released_state, write_pth
from small import random_variables, small_config

from ciassd_jax import Config, Detector, car_lite, car_released, init_variables
from ciassd_jax.formats.errors import InputError
from ciassd_jax.inference.weights import load_released_weights, load_weights, read_config, save_weights


def released_file(folder: Path, state: State) -> Path:
    safetensors.numpy.save_file(state, folder / "released.safetensors")
    return folder / "released.safetensors"


def assert_same(a: Any, b: Any) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    jax.tree.map(np.testing.assert_array_equal, a, b)


def edit(path: Path, change: Any, **metadata: str) -> Path:
    """Rewrite a file of this package after `change(tensors)`."""
    with safetensors.safe_open(path, framework="numpy") as file:
        before = file.metadata()
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    change(tensors)
    safetensors.numpy.save_file(tensors, path, metadata=before | metadata)
    return path


@pytest.fixture
def ours(tmp_path: Path) -> Path:
    config = small_config()
    save_weights(tmp_path / "ours.safetensors", random_variables(config), config)
    return tmp_path / "ours.safetensors"


def test_what_is_saved_is_loaded(ours: Path) -> None:
    loaded = load_weights(ours)
    assert loaded.config == small_config()
    assert_same(loaded.variables, random_variables(small_config()))
    assert {row.status for row in loaded.report} == {"mapped"}
    assert list(ours.parent.iterdir()) == [ours]


def test_half_kernels_are_rounded_and_nothing_else(tmp_path: Path) -> None:
    config, variables = small_config(), random_variables(small_config())
    save_weights(tmp_path / "half.safetensors", variables, config, half_kernels=True)

    def rounded(keys: tuple, leaf: np.ndarray) -> np.ndarray:
        return np.float32(np.float16(leaf)) if keys[-1].key == "kernel" else leaf

    assert_same(
        load_weights(tmp_path / "half.safetensors").variables, jax.tree_util.tree_map_with_path(rounded, variables)
    )


def test_a_kernel_beyond_float16_is_named(tmp_path: Path) -> None:
    variables = jax.tree.map(lambda leaf: leaf * np.float32(1e6), random_variables(small_config()))
    with pytest.raises(InputError, match=r"params/.*/kernel exceeds 65504"):
        save_weights(tmp_path / "half.safetensors", variables, small_config(), half_kernels=True)
    assert not list(tmp_path.iterdir())


def test_saved_metadata_names_the_classes(ours: Path) -> None:
    with safetensors.safe_open(ours, framework="numpy") as file:
        assert json.loads(file.metadata()["class_names"]) == ["Car"]


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"file/w\.safetensors cannot be written"):
        save_weights(tmp_path / "file" / "w.safetensors", random_variables(small_config()), small_config())


NAME = "params/head/box/kernel"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop(NAME), r"head/box/kernel is absent in the file and \(1, 1, 16, 14\) in the config"),
        (lambda t: t.update(extra=np.zeros(3, np.float32)), r"extra is \(3,\) in the file and absent in the config"),
        (
            lambda t: t.update({NAME: t[NAME][..., :3]}),
            r"\(1, 1, 16, 3\) in the file and \(1, 1, 16, 14\) in the config",
        ),
    ],
    ids=["missing", "unexpected", "shape"],
)
def test_our_file_must_fit_exactly(ours: Path, change: Any, message: str) -> None:
    with pytest.raises(InputError, match=f"does not fit its model in 1 of .*{message}; give the complete file"):
        load_weights(edit(ours, change))


@pytest.mark.parametrize("value", [np.nan, np.float64(1e39)], ids=["nan", "beyond float32"])
def test_values_that_are_not_finite_are_refused(ours: Path, value: float) -> None:
    edit(ours, lambda tensors: tensors.update({NAME: np.full_like(tensors[NAME], value, type(value))}))
    for options in ({}, {"config": three_classes(), "partial": True}):
        with pytest.raises(InputError, match=f"not finite in {NAME}; give other weights"):
            load_weights(ours, **options)


@pytest.mark.parametrize(("name", "words"), [("novelty", "known are backbone"), ("scedule", "did you mean 'schedule'")])
def test_a_config_of_another_version_is_named(ours: Path, name: str, words: str) -> None:
    config = json.loads(small_config().to_json()) | {name: 1}
    with pytest.raises(InputError, match=rf"ours\.safetensors .*another version of the package: .*'{name}'.*{words}"):
        load_weights(edit(ours, lambda tensors: None, config=json.dumps(config)))


# New to old names. Earlier versions also repeated `grid.max_voxels` as the first stage's capacity.
OLD_NAMES = {
    "gt_sampling": "paste",
    "max_gt_sampling_points": "max_paste_points",
    "gt_sampling_up_to": "paste_up_to",
    "gt_sampling_min_points": "paste_min_points",
    "nms_iou_threshold": "nms_overlap",
    "gradient_accumulation_steps": "accumulate",
    "remat": "rematerialize",
    "b1_range": "momentum",
    "b2": "second_moment",
    "div_factor": "start_divisor",
    "final_div_factor": "end_divisor",
}


@pytest.mark.filterwarnings("error")
def test_a_file_with_the_old_names_loads_as_before(ours: Path) -> None:
    text = small_config().to_json().replace('"capacity": null', f'"capacity": {small_config().grid.max_voxels}')
    for new, old in OLD_NAMES.items():
        assert f'"{new}":' in text
        text = text.replace(f'"{new}":', f'"{old}":')
    loaded = load_weights(edit(ours, lambda tensors: None, config=text))
    assert loaded.config == small_config()
    assert_same(loaded.variables, random_variables(small_config()))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "path", ["ciassd_jax/bundled/car_lite.safetensors", "experiments/checkpoints/car_lite_kitti110.safetensors"]
)
def test_files_of_the_repository_load(path: str) -> None:
    loaded = load_weights(Path(__file__).parents[2] / path)
    expected = car_lite()
    training = {"data": expected.data, "schedule": expected.schedule}
    assert replace(loaded.config, **training) == expected
    assert {row.status for row in loaded.report} == {"mapped"}


@pytest.mark.parametrize("keep", [0, 7, 500, -1])
def test_a_truncated_file_is_refused(ours: Path, keep: int) -> None:
    ours.write_bytes(ours.read_bytes()[:keep])
    with pytest.raises(InputError, match=r"ours\.safetensors is not a complete safetensors file .*again"):
        load_weights(ours)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    for name in ("none.safetensors", "none.pth"):
        with pytest.raises(InputError, match=f"{re.escape(name)} .*check the path"):
            load_weights(tmp_path / name)


def three_classes() -> Config:
    config = small_config()
    return replace(config, classes=tuple(replace(config.classes[0], name=name) for name in ("Car", "Van", "Truck")))


def flat(variables: Any) -> dict[str, np.ndarray]:
    leaves = jax.tree_util.tree_flatten_with_path(variables)[0]
    return {"/".join(key.key for key in keys): leaf for keys, leaf in leaves}


def test_the_config_may_be_another_of_the_same_tensors(ours: Path) -> None:
    config = replace(small_config(), dtype="bfloat16")
    loaded = load_weights(ours, config)
    assert loaded.config == config
    assert_same(loaded.variables, random_variables(small_config()))


def test_a_config_of_other_tensors_is_refused(ours: Path) -> None:
    message = (
        r"ours\.safetensors does not fit the config in 8 of 98 tensors: params/head/\S+ is .*; use .* or `partial`"
    )
    with pytest.raises(InputError, match=message):
        load_weights(ours, three_classes())


def test_a_partial_load_takes_what_fits_and_draws_the_rest(ours: Path) -> None:
    config = three_classes()
    edit(ours, lambda tensors: tensors.update(extra=np.zeros(3, np.float32)) or tensors.pop("params/head/iou/bias"))
    loaded = load_weights(ours, config, partial=True, key=jax.random.key(3))
    assert loaded.config == config
    given, fresh = flat(random_variables(small_config())), flat(init_variables(jax.random.key(3), config))
    found = flat(loaded.variables)
    assert found.keys() == fresh.keys()
    for name, leaf in found.items():
        np.testing.assert_array_equal(leaf, fresh[name] if "/head/" in name else given[name])
    rows = {row.target: row for row in loaded.report}
    assert rows.keys() == found.keys() | {"extra"}
    assert {row.status for name, row in rows.items() if "/head/" not in name and name != "extra"} == {"mapped"}
    assert rows[NAME] == (NAME, NAME, (1, 1, 16, 14), (1, 1, 16, 42), "fresh: other shape")
    assert rows["params/head/iou/bias"] == ("", "params/head/iou/bias", None, (6,), "fresh: not in the file")
    assert rows["extra"] == ("extra", "extra", (3,), None, "left: not in the config")


def test_a_partial_load_of_a_released_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def draw(key: jax.Array, config: Config) -> Any:
        assert key == jax.random.key(0)
        return random_variables(config)

    monkeypatch.setattr("ciassd_jax.inference.weights.init_variables", draw)
    state = released_state()
    config = replace(car_released(), head=replace(car_released().head, iou_kernel=1, iou_bias=True))
    loaded = load_weights(write_pth(tmp_path / "released.pth", {"state_dict": state}), config, partial=True)
    whole = flat(load_released_weights(released_file(tmp_path, state)).variables)
    assert {row.target: row.status for row in loaded.report if row.status.startswith("fresh")} == {
        "params/head/iou/kernel": "fresh: other shape",
        "params/head/iou/bias": "fresh: not in the file",
    }
    for name, leaf in flat(loaded.variables).items():
        if "/iou/" not in name:
            np.testing.assert_array_equal(leaf, whole[name])


def test_a_partial_load_where_nothing_fits_is_refused(ours: Path) -> None:
    edit(ours, lambda tensors: [tensors.update({name: tensors[name][None]}) for name in tensors])
    with pytest.raises(InputError, match=r"No tensor of .*ours\.safetensors fits the config: .*; use the config of"):
        load_weights(ours, three_classes(), partial=True)


def test_a_partial_load_needs_a_config(ours: Path) -> None:
    with pytest.raises(ValueError, match=r"`partial` .* `config`; give both"):
        load_weights(ours, partial=True)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_released_kernels_of_every_layout_give_the_same_variables(tmp_path: Path, layout: str) -> None:
    state = released_state()
    weights = load_released_weights(released_file(tmp_path, released_state(layout)))
    assert weights.config == car_released()
    params, statistics = weights.variables["params"], weights.variables["batch_stats"]
    same = np.testing.assert_array_equal
    same(params["backbone"]["stage0_0"]["kernel"], state["backbone.middle_conv.0.weight"])
    same(params["backbone"]["stage3_down"]["kernel"], state["backbone.middle_conv.27.weight"])
    same(params["backbone"]["out"]["kernel"], state["backbone.middle_conv.39.weight"])
    same(statistics["backbone"]["stage1_0"]["norm"]["var"], state["backbone.middle_conv.10.running_var"])
    same(params["neck"]["semantic_0"]["kernel"], state["neck.bottom_up_block_1.0.weight"].transpose(2, 3, 1, 0))
    same(params["neck"]["upsample_to_spatial"]["kernel"], state["neck.deconv_block_0.0.weight"].transpose(2, 3, 0, 1))
    same(params["neck"]["semantic_attention"]["norm"]["scale"], state["neck.w_1.1.weight"])
    same(params["head"]["iou"]["kernel"], state["bbox_head.tasks.0.conv_iou.weight"].transpose(2, 3, 1, 0))
    rows = {row.source: row for row in weights.report}
    assert rows.keys() == state.keys()
    assert rows["neck.w_0.0.weight"].status == "transposed"
    assert rows["neck.w_0.1.num_batches_tracked"].status == "counter"


@pytest.mark.parametrize("iou", [(3, False), (1, True)])
def test_the_iou_head_is_that_of_the_file(tmp_path: Path, iou: tuple[int, bool]) -> None:
    weights = load_released_weights(released_file(tmp_path, released_state(iou=iou)))
    assert (weights.config.head.iou_kernel, weights.config.head.iou_bias) == iou
    assert weights.variables["params"]["head"]["iou"]["kernel"].shape == (iou[0], iou[0], 128, 2)


@pytest.mark.parametrize("legacy", [False, True], ids=["zip", "legacy"])
@pytest.mark.parametrize("wrapped", [False, True], ids=["bare", "with optimizer"])
def test_released_pth_of_both_formats(tmp_path: Path, legacy: bool, wrapped: bool) -> None:
    state = {f"module.{name}": value for name, value in released_state(counters=False).items()}
    content = {"state_dict": state, "optimizer": {"lr": 0.1}, "meta": {"epoch": 60}} if wrapped else state
    loaded = load_weights(write_pth(tmp_path / "released.pth", content, legacy=legacy))
    plain = load_released_weights(released_file(tmp_path, released_state()))
    assert loaded.config == plain.config
    assert_same(loaded.variables, plain.variables)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.pop("neck.w_0.0.weight"), "neck/spatial_attention/kernel is absent in the file"),
        (lambda s: s.update({"neck.w_9.weight": np.zeros(1, np.float32)}), r"neck\.w_9\.weight is \(1,\) in the file"),
        (lambda s: s.pop("bbox_head.tasks.0.conv_iou.weight"), "head/iou/kernel is absent in the file"),
        (
            lambda s: s.update({"neck.conv_0.0.weight": s["neck.conv_0.0.weight"][:, :64]}),
            r"neck\.conv_0\.0\.weight is \(128, 64, 3, 3\) in the file and \(3, 3, 128, 128\) in the config",
        ),
    ],
    ids=["missing", "unexpected", "no iou head", "shape"],
)
def test_a_released_model_must_fit_exactly(tmp_path: Path, change: Any, message: str) -> None:
    state = released_state()
    change(state)
    with pytest.raises(InputError, match=f"does not fit its model in 1 of .*{message}"):
        load_released_weights(released_file(tmp_path, state))


def test_mixed_layouts_are_refused(tmp_path: Path) -> None:
    other = released_state("spconv 2")["backbone.middle_conv.0.weight"]
    state = released_state() | {"backbone.middle_conv.0.weight": other}
    with pytest.raises(InputError, match="sparse kernels of layouts"):
        load_released_weights(released_file(tmp_path, state))


def test_a_foreign_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"other\.pth .*not a released CIA-SSD model"):
        load_weights(write_pth(tmp_path / "other.pth", {"state_dict": {"conv.weight": np.zeros(3, np.float32)}}))
    with pytest.raises(InputError, match=r"odd\.pth .*dictionary of tensors"):
        load_weights(write_pth(tmp_path / "odd.pth", {"state_dict": [1, 2]}))


def test_each_loader_refuses_the_other_kind_of_file(tmp_path: Path, ours: Path) -> None:
    path = released_file(tmp_path, released_state())
    with pytest.raises(InputError, match=f"`ciassd convert {path} OUT.safetensors`"):
        load_weights(path)
    with pytest.raises(InputError, match=r"ours\.safetensors is already"):
        load_released_weights(ours)


@pytest.mark.reference
def test_golden_weights_load_with_every_tensor_accounted_for(shared: Path) -> None:
    weights = load_weights(shared / "golden" / "weights.pth")
    assert weights.config == car_released()
    assert len(weights.report) == 175
    counts = {s: sum(row.status == s for row in weights.report) for s in ("mapped", "transposed", "counter")}
    assert counts == {"mapped": 14 + 28 * 4 + 3, "transposed": 14 + 4, "counter": 28}
    assert_same(weights.variables, load_released_weights(shared / "golden" / "weights.safetensors").variables)


@pytest.mark.reference
def test_a_part_of_the_golden_weights_is_refused(shared: Path) -> None:
    with pytest.raises(InputError, match=r"weights_legacy_format_sample\.pth (does not fit|has sparse kernels)"):
        load_weights(shared / "golden" / "weights_legacy_format_sample.pth")


def test_bundled_weights_load_by_name_and_print_short():
    weights = load_weights("car_lite")
    assert weights.config.class_names == ("Car",)
    assert read_config("car_lite") == weights.config
    assert repr(weights) == "Weights(variables={841,822 numbers}, config={Car}, report=[118 tensors])"
    assert repr(Detector(weights.variables, weights.config)) == "Detector(Car in x 0..70.4, y -40..40 m)"
    with pytest.raises(InputError, match="No bundled weights are named 'car_litle'"):
        load_weights("car_litle")
