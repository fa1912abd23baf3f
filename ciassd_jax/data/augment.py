"""Augmentation of one padded scene on the device (section 4.1); `vmap` it for a batch.

Every step is a pure function with fixed shapes and keeps padding zero. A random step draws its numbers and passes them
to a deterministic function, which tests compare with its definition.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float

from ciassd_jax.config import AugmentationConfig, Config
from ciassd_jax.ops.footprints import footprint_corners, footprints_collide, points_in_boxes
from ciassd_jax.types import Array, Boxes, GroundTruth, PointCloud, SampledObjects, Scene


def scene_key(seed: int | Array, epoch: int | Array, frame: int | Array) -> jax.Array:
    """Return the key of a scene's augmentation, which does not depend on the order of the scenes."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), epoch), frame)


def augment(key: jax.Array, scene: Scene, objects: SampledObjects, config: Config) -> Scene:
    """Augment one scene as configured by `config.data.augmentation`.

    The steps are ground-truth sampling, noise on each object, flip, rotation and scaling of the scene, and shuffling
    of its points. Obstacles block other objects and are dropped at the end. Each step has its own key, so that
    disabling one does not change what the others draw.
    """
    switches = config.data.augmentation
    for_noise, for_transform, for_order = jax.random.split(key, 3)
    gt_sampling_up_to = tuple(one.gt_sampling_up_to for one in config.classes)
    if switches.gt_sampling and any(gt_sampling_up_to):
        scene = add_sampled_objects(scene, objects, gt_sampling_up_to=gt_sampling_up_to)
    if switches.object_noise:
        scene = add_object_noise(for_noise, scene, switches)
    if switches.global_transform:
        scene = transform_globally(for_transform, scene, switches)
    scene = shuffle_points(for_order, scene)
    minimum, maximum = config.range
    return keep_targets(scene, minimum=minimum, maximum=maximum)


def add_sampled_objects(scene: Scene, objects: SampledObjects, *, gt_sampling_up_to: tuple[int, ...]) -> Scene:
    """Add the sampled objects that collide with nothing, their points first, and remove scene points inside them.

    `gt_sampling_up_to` is the number of slots per round of each class, not all 0. An object without a free box slot is
    not added, and points over capacity are cut from the end of the scene's; both are counted.
    """
    accepted = accept_objects(scene.truth, objects, gt_sampling_up_to=gt_sampling_up_to)
    added = accepted & (scene.truth.count + jnp.cumsum(accepted) <= scene.truth.label.shape[0])

    points, capacity = scene.cloud.points, scene.cloud.points.shape[0]
    covered = jnp.any(points_in_boxes(points, objects.boxes) & added[:, None], 0)
    comes = jnp.take(added, objects.owner, mode="fill", fill_value=False)
    kept = jnp.concatenate([comes, _real_points(scene) & ~covered])
    total = kept.sum(dtype=jnp.int32)
    points = _pick(jnp.concatenate([objects.points, points]), kept, capacity)

    boxes = Boxes(*(jnp.concatenate(pair) for pair in zip(scene.truth.boxes, objects.boxes, strict=True)))
    truth = GroundTruth(boxes, jnp.concatenate([scene.truth.label, objects.label]), scene.truth.count)
    kept = jnp.concatenate([_real_boxes(scene.truth), added])
    return scene._replace(
        cloud=PointCloud(points, jnp.minimum(total, capacity)),
        truth=_pick_truth(truth, kept, scene.truth.label.shape[0]),
        points_cut=scene.points_cut + jnp.maximum(total - capacity, 0),
        boxes_cut=scene.boxes_cut + (accepted & ~added).sum(dtype=jnp.int32),
        objects_cut=scene.objects_cut + objects.cut,
    )


def accept_objects(
    truth: GroundTruth, objects: SampledObjects, *, gt_sampling_up_to: tuple[int, ...]
) -> Bool[Array, " O"]:
    """Return which sampled objects to add: two rounds per class, the second for the objects still lacking.

    The draws of a round are tested in order. A draw is rejected if it collides with a truth box, an accepted object or
    a later draw of its round; of two draws that collide the earlier one is therefore rejected.
    """
    boxes = _with_axis(objects.boxes, 1)
    blocked = jnp.any(footprints_collide(boxes, _with_axis(truth.boxes, 0)) & _real_boxes(truth)[None], 1)
    itself = jnp.eye(blocked.shape[0], dtype=bool)
    collide = jnp.asarray(footprints_collide(boxes, _with_axis(objects.boxes, 0))) & ~itself

    def judge(slot: jax.Array, alive: jax.Array) -> jax.Array:
        return alive.at[slot].set(alive[slot] & ~blocked[slot] & ~jnp.any(collide[slot] & alive))

    alive, start = jnp.zeros_like(blocked), 0
    for label, slots in enumerate(gt_sampling_up_to):
        wanted = objects.wanted[label]
        for _ in range(2):
            stop = start + slots
            draws = objects.valid[start:stop]
            draws &= jnp.cumsum(draws) <= wanted
            alive = lax.fori_loop(start, stop, judge, alive.at[start:stop].set(draws))
            wanted -= alive[start:stop].sum(dtype=jnp.int32)
            start = stop
    return alive


def add_object_noise(key: jax.Array, scene: Scene, config: AugmentationConfig) -> Scene:
    """Shift and rotate every target with its points, by the first of its tries that collides with nothing."""

    def draw(slot: Array) -> tuple[jax.Array, jax.Array]:
        for_shift, for_turn = jax.random.split(jax.random.fold_in(key, slot))
        shift = jax.random.normal(for_shift, (config.noise_tries, 3)) * jnp.array([config.noise_shift])
        limit = config.noise_rotation
        return shift, jax.random.uniform(for_turn, (config.noise_tries,), minval=-limit, maxval=limit)

    # One key per box, so that the capacity for boxes does not change the draws.
    shifts, turns = jax.vmap(draw)(jnp.arange(scene.truth.label.shape[0]))
    return move_objects(scene, shifts, turns)


def move_objects(scene: Scene, shifts: Float[Array, "G T 3"], turns: Float[Array, "G T"]) -> Scene:
    """Move each target by the first of its T shifts (metres) and turns (radians) that collides with no other box.

    Boxes move one after the other and later ones see the new places; without a free try a box stays. A point moves
    with the first target that contained it before any moved. Points at the destination stay.
    """
    boxes, label, count = scene.truth
    slots, real = jnp.arange(label.shape[0], dtype=jnp.int32), _real_boxes(scene.truth)
    target = real & (label >= 0)

    def move(slot: Array, moved: Boxes) -> Boxes:
        size = jnp.broadcast_to(moved.size[slot], shifts[slot].shape)
        tries = Boxes(moved.center[slot][None] + shifts[slot], size, moved.yaw[slot] + turns[slot])
        others = real & (slots != slot)
        clear = ~jnp.any(footprints_collide(_with_axis(tries, 1), _with_axis(moved, 0)) & others[None], 1)
        first = jnp.argmax(clear)
        moves = target[slot] & clear[first]
        return jax.tree.map(lambda leaf, new: leaf.at[slot].set(jnp.where(moves, new[first], leaf[slot])), moved, tries)

    moved = lax.fori_loop(0, count, move, jax.tree.map(jnp.asarray, boxes))
    points = scene.cloud.points
    held = points_in_boxes(points, boxes) & target[:, None] & _real_points(scene)[None]
    owner = jnp.where(held, slots[:, None], slots.shape[0]).min(0)
    return scene._replace(
        cloud=scene.cloud._replace(points=_carry(points, owner, boxes, moved)),
        truth=scene.truth._replace(boxes=moved),
    )


def _carry(points: Array, owner: Array, before: Boxes, after: Boxes) -> Array:
    """Return points moved with the box of slot `owner`; points of a box that stays keep their bits."""
    turn = after.yaw - before.yaw
    moves = jnp.any(before.center != after.center, 1) | (turn != 0)
    table = jnp.concatenate([before.center, after.center, jnp.stack([jnp.cos(turn), jnp.sin(turn), moves], 1)], 1)
    row = jnp.take(table, owner, axis=0, mode="fill", fill_value=0)
    turned = _turned(points[:, :3] - row[:, :3], row[:, 6], row[:, 7])
    moved = jnp.concatenate([row[:, 3:6] + turned, points[:, 3:]], 1)
    return jnp.where(row[:, 8:] > 0, moved, points)


def transform_globally(key: jax.Array, scene: Scene, config: AugmentationConfig) -> Scene:
    """Flip the scene at random, then rotate and scale it."""
    for_flip, for_angle, for_factor = jax.random.split(key, 3)
    angle = jax.random.uniform(for_angle, minval=-config.max_rotation, maxval=config.max_rotation)
    factor = jax.random.uniform(for_factor, minval=config.min_scale, maxval=config.max_scale)
    scene = flip(scene, jax.random.bernoulli(for_flip, config.flip_probability))
    return scale(rotate(scene, angle), factor)


def flip(scene: Scene, mirrored: Bool[Array, ""]) -> Scene:
    """Mirror y and yaw if `mirrored`."""
    sign = jnp.where(mirrored, -1.0, 1.0)
    (center, size, yaw), points = scene.truth.boxes, scene.cloud.points
    mirror = jnp.ones(4).at[1].set(sign)[None]
    return _with_geometry(scene, points * mirror, Boxes(center * mirror[:, :3], size, yaw * sign))


def rotate(scene: Scene, angle: Float[Array, ""]) -> Scene:
    """Rotate the scene by `angle` radians about the z axis, counter-clockwise."""
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    (center, size, yaw), points = scene.truth.boxes, scene.cloud.points
    turned = yaw + jnp.where(_real_boxes(scene.truth), angle, 0)
    return _with_geometry(scene, _turned(points, cosine, sine), Boxes(_turned(center, cosine, sine), size, turned))


def scale(scene: Scene, factor: Float[Array, ""]) -> Scene:
    """Multiply coordinates and sizes by `factor`."""
    (center, size, yaw), points = scene.truth.boxes, scene.cloud.points
    factors = jnp.ones(4).at[:3].set(factor)[None]
    return _with_geometry(scene, points * factors, Boxes(center * factor, size * factor, yaw))


def shuffle_points(key: jax.Array, scene: Scene) -> Scene:
    """Put the real points into a uniformly random order."""
    points = scene.cloud.points
    # The second key keeps padding last.
    order = jnp.lexsort((jax.random.bits(key, points.shape[:1]), ~_real_points(scene)))
    return scene._replace(cloud=scene.cloud._replace(points=jnp.take(points, order, axis=0)))


def keep_targets(scene: Scene, *, minimum: tuple[float, float, float], maximum: tuple[float, float, float]) -> Scene:
    """Drop obstacles, and targets without a footprint corner strictly inside the range in x and y.

    Scenes that are not augmented need this step too. `boxes_cut` does not count the dropped boxes, as none of them is
    a target.
    """
    corners = footprint_corners(scene.truth.boxes)
    low, high = (jnp.array(limit[:2], corners.dtype)[None, None] for limit in (minimum, maximum))
    seen = jnp.any(jnp.all((corners > low) & (corners < high), -1), -1)
    kept = _real_boxes(scene.truth) & (scene.truth.label >= 0) & seen
    return scene._replace(truth=_pick_truth(scene.truth, kept, kept.shape[0]))


def _real_points(scene: Scene) -> jax.Array:
    return jnp.arange(scene.cloud.points.shape[0]) < scene.cloud.count


def _real_boxes(truth: GroundTruth) -> jax.Array:
    return jnp.arange(truth.label.shape[0]) < truth.count


def _with_geometry(scene: Scene, points: Array, boxes: Boxes) -> Scene:
    return scene._replace(cloud=scene.cloud._replace(points=points), truth=scene.truth._replace(boxes=boxes))


def _with_axis(boxes: Boxes, axis: int) -> Boxes:
    return jax.tree.map(lambda leaf: jnp.expand_dims(leaf, axis), boxes)


def _turned(points: Array, cosine: Array, sine: Array) -> Array:
    """Return points (x and y first) rotated counter-clockwise about the z axis."""
    x, y = points[:, 0], points[:, 1]
    return jnp.concatenate([jnp.stack([x * cosine - y * sine, x * sine + y * cosine], 1), points[:, 2:]], 1)


def _pick(array: Array, kept: Array, size: int, fill: int = 0) -> Array:
    """Return the first `size` kept rows in order, padded with `fill`."""
    rows = jnp.flatnonzero(kept, size=size, fill_value=kept.shape[0])
    return jnp.take(array, rows, axis=0, mode="fill", fill_value=fill)


def _pick_truth(truth: GroundTruth, kept: Array, size: int) -> GroundTruth:
    """Return the first `size` kept boxes, padded."""
    boxes = jax.tree.map(lambda leaf: _pick(leaf, kept, size), truth.boxes)
    return GroundTruth(boxes, _pick(truth.label, kept, size, fill=-1), kept.sum(dtype=jnp.int32))
