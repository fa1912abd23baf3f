"""Records print their shapes in short, wherever they are printed."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small import random_scene, small_config

from ciassd_jax import create_train_state, types
from ciassd_jax.types import Boxes, LossTerms, PointCloud, Scene

CLOUD = PointCloud(np.zeros((4, 32768, 4), np.float32), np.array([3, 1, 4, 1], np.int32))
SHAPES = "PointCloud(points=float32[4, 32768, 4], count=int32[4])"


def test_a_train_state_prints_its_step_and_the_size_of_its_trees() -> None:
    shapes = jax.eval_shape(lambda: create_train_state(jax.random.key(0), small_config()))
    state = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)._replace(step=jnp.int32(12))
    leaves = jax.tree.leaves(state.params)
    text = str(state)
    size = f"params={{{len(leaves)} arrays, {sum(leaf.size for leaf in leaves):,} numbers}}"
    assert text.startswith(f"TrainState(step=12, {size}, batch_stats={{")
    assert text.endswith("ema=None, skipped=0)")
    assert len(text) < 500
    assert str(shapes).startswith(f"TrainState(step=int32[], {size}")


def test_records_within_records_print_shapes_and_few_numbers() -> None:
    assert repr(CLOUD) == "PointCloud(points=float32[4, 32768, 4], count=[3, 1, 4, 1])"
    assert repr(jax.device_put(CLOUD)) == repr(CLOUD)
    scene = random_scene(small_config(), 7)
    assert repr(scene).startswith("Scene(cloud=PointCloud(points=float32[")
    assert ", count=600), truth=GroundTruth(boxes=Boxes(center=float32[" in repr(scene)
    assert repr(scene).endswith("frame=7, points_cut=0, boxes_cut=0, objects_cut=0)")
    assert repr(LossTerms(*np.float32([0.123456, 0.5, 2, 0, np.nan]))) == (
        "LossTerms(classification=0.1235, box=0.5, direction=2., iou=0., total=nan)"
    )


def test_every_record_prints_so() -> None:
    records = [value for value in vars(types).values() if hasattr(value, "_fields")]
    assert len(records) > 10
    for record in records:
        lots = record(*[np.zeros(1000, np.float32)] * len(record._fields))
        assert repr(lots) == f"{record.__name__}({', '.join(f'{name}=float32[1000]' for name in record._fields)})"
    # Others keep their own.
    assert repr(jax.ShapeDtypeStruct((2,), np.float32)) == "ShapeDtypeStruct(shape=(2,), dtype=float32)"


def test_printing_needs_no_trace() -> None:
    seen = []

    def look(cloud: PointCloud) -> jax.Array:
        seen.append(repr(cloud))
        return cloud.points.sum()

    jax.eval_shape(look, CLOUD)
    jax.make_jaxpr(jax.vmap(look))(CLOUD)
    jax.make_jaxpr(jax.grad(look, allow_int=True))(CLOUD)
    assert seen == [SHAPES, "PointCloud(points=float32[32768, 4], count=int32[])", SHAPES]


def test_a_donated_array_prints_its_shape() -> None:
    cloud = jax.device_put(CLOUD)
    for leaf in cloud:
        leaf.delete()
    assert repr(cloud) == SHAPES


OTHERS: dict[str, tuple[Any, str]] = {
    "none": (None, "None"),
    "shape": (jax.ShapeDtypeStruct((), np.int32), "int32[]"),
    "tree": ({"a": np.zeros(3), "b": [np.zeros((2, 5))]}, "{2 arrays, 13 numbers}"),
    "number": (3, "3"),
    "key": (jax.random.key(0), "key<fry>[]"),
    "bfloat16": (jnp.bfloat16(1.5), "1.5"),
    "text": ("x", "'x'"),
    "class": (np.ndarray, "<class 'numpy.ndarray'>"),
    "dimensions": ((2, 3), "(2, 3)"),
}


@pytest.mark.parametrize(("value", "text"), OTHERS.values(), ids=OTHERS.keys())
def test_a_leaf_may_be_anything(value: Any, text: str) -> None:
    """As in the tree of specifications of a record, or of what a function of its leaves returns."""
    assert repr(CLOUD._replace(points=value)) == f"PointCloud(points={text}, count=[3, 1, 4, 1])"


def test_a_record_is_a_tuple_and_a_tree_as_before() -> None:
    boxes = Boxes.from_array(np.arange(14, dtype=np.float32).reshape(2, 7))
    center, size, yaw = boxes
    assert isinstance(boxes, tuple)
    np.testing.assert_array_equal(jax.tree.map(lambda leaf: leaf + 1, boxes).yaw, yaw + 1)
    assert jax.tree.structure(boxes) == jax.tree.structure(Boxes(center, size, yaw))
    assert Scene._fields[0] == "cloud"
