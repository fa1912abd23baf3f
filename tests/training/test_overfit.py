"""The model can overfit two scenes: every car is found at a 3D IoU of 0.7."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from small import random_scene, random_variables, small_config

from ciassd_jax import Config, create_train_state, predict, train_step
from ciassd_jax.ops.iou import iou_3d
from ciassd_jax.types import Boxes, Scene

STEPS, CARS, POINTS = 600, 2, 150


def seen_scene(config: Config, seed: int) -> Scene:
    """A random scene with additional points inside every car."""
    rng = np.random.default_rng(seed)
    scene = random_scene(config, seed)
    points, count = scene.cloud.points.copy(), int(scene.cloud.count)
    for box in scene.truth.boxes.to_array()[:CARS]:
        local = rng.uniform(-0.5, 0.5, (POINTS, 3)) * box[3:6]
        cosine, sine = np.cos(box[6]), np.sin(box[6])
        turned = local @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
        points[count : count + POINTS, :3] = turned + box[:3]
        count += POINTS
    return scene._replace(cloud=scene.cloud._replace(points=points, count=np.int32(count)))


@pytest.mark.slow
def test_every_car_of_two_scenes_is_found_after_training() -> None:
    config = small_config()
    schedule = replace(config.schedule, total_steps=STEPS, learning_rate=1e-2)
    config = replace(config, data=replace(config.data, max_points=1024), schedule=schedule)
    scenes = [seen_scene(config, seed) for seed in range(2)]
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *scenes)
    state = create_train_state(jax.random.key(0), config, variables=random_variables(config))
    step = jax.jit(train_step, static_argnames="config", donate_argnums=0)
    for _ in range(STEPS):
        state, _ = step(state, batch, config)
    found = jax.device_get(predict(state, batch.cloud, config))
    for i, scene in enumerate(scenes):
        cars = jax.tree.map(lambda leaf: np.asarray(leaf)[:CARS, None], scene.truth.boxes)
        boxes = jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i, : found.count[i]][None], found.boxes)
        overlaps = np.asarray(iou_3d(Boxes(*cars), Boxes(*boxes)))
        assert overlaps.shape[1]
        assert overlaps.max(1).min() > 0.7, overlaps
