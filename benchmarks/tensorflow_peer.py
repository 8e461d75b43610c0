"""The original's training step rebuilt in TensorFlow, run eagerly: what `models.py` compares with.

    python -m venv tf && tf/bin/pip install tensorflow-cpu
    python benchmarks/models.py --tensorflow tf/bin/python

A file of its own that needs TensorFlow alone, in an environment of its own. A step is what the
original's is with one rotation and batch 1: the attention network on the picture padded to a
square, key and query networks (and the goal's) on the picture padded by half a crop, a crop of the
query's map correlated with the key's directly, two cross entropies, and Adam for the attention and
for the transport networks. Left out is what costs little: reading, augmentation, turning by 0.
Prints one JSON object: CPU times of the steps after the first [s], and the number of parameters.

Source: Zeng et al., CoRL 2020; Seita et al., ICRA 2021, appendix on models.
"""

from __future__ import annotations

import argparse
import json
import os
import time

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import numpy as np
import tensorflow as tf

SHAPE, CROP, FEATURES = (320, 160), 64, 3
PARAMETERS = {"transporter": 9_833_203 + 19_666_866, "goal-split": 9_836_659 + 29_500_299}
"""Of attention and transport, as the original's; attention sees the goal's picture too."""


def network(channels: int, out: int) -> tf.keras.Model:
    """The 43-layer network: pictures (B, H, W, channels) -> maps (B, H, W, out)."""
    conv = tf.keras.layers.Conv2D

    def block(x, middle, last, *, stride=1, shortcut=False, activate=True):
        y = conv(middle, 1, strides=stride, activation="relu")(x)
        y = conv(middle, 3, padding="same", activation="relu")(y)
        y = conv(last, 1)(y) + (conv(last, 1, strides=stride)(x) if shortcut else x)
        return tf.keras.layers.ReLU()(y) if activate else y

    def stage(x, middle, last, *, stride=1, activate=True):
        x = block(x, middle, last, stride=stride, shortcut=True, activate=activate)
        return block(x, middle, last, activate=activate)

    grow = tf.keras.layers.UpSampling2D
    seen = tf.keras.Input((None, None, channels))
    x = conv(64, 3, padding="same", activation="relu")(seen)
    for width, stride in ((64, 1), (128, 2), (256, 2), (512, 2), (256, 1)):
        x = stage(x, width, width, stride=stride)
    for width in (128, 64):
        x = stage(grow(2, interpolation="bilinear")(x), width, width)
    x = stage(grow(2, interpolation="bilinear")(x), 16, out, activate=False)
    return tf.keras.Model(seen, x)


class Original:
    """Attention and transport of an agent, and their optimisers."""

    def __init__(self, agent: str) -> None:
        self.split = agent == "goal-split"
        self.attention = network(12 if self.split else 6, 1)
        self.transport = [network(6, FEATURES) for _ in range(3 if self.split else 2)]
        self.variables = [v for net in self.transport for v in net.trainable_variables]
        self.optimisers = [tf.keras.optimizers.Adam(1e-4) for _ in range(2)]
        counted = self.attention.count_params() + sum(n.count_params() for n in self.transport)
        if counted != PARAMETERS[agent]:
            raise SystemExit(f"{agent}: {counted} parameters, the original has {PARAMETERS[agent]}")

    def step(self, rng: np.random.Generator) -> None:
        """One step on a random picture with random labels."""
        channels = 12 if self.split else 6
        picture = tf.constant(rng.normal(size=(1, *SHAPE, channels)).astype(np.float32))
        pick, place = (rng.integers(0, SHAPE) for _ in range(2))
        side = (SHAPE[0] - SHAPE[1]) // 2
        with tf.GradientTape() as tape:
            logits = self.attention(tf.pad(picture, [[0, 0], [0, 0], [side, side], [0, 0]]))
            loss = cross_entropy(logits[:, :, side:-side], pick)
        self._apply(0, tape, loss, self.attention.trainable_variables)
        half = CROP // 2
        with tf.GradientTape() as tape:
            padded = tf.pad(picture, [[0, 0], [half, half], [half, half], [0, 0]])
            key, query = (net(padded[..., :6]) for net in self.transport[:2])
            if self.split:
                goal = self.transport[2](padded[..., 6:])
                key, query = key * goal, query * goal
            row, column = pick
            crop = query[0, row : row + CROP, column : column + CROP, :, None]
            kernel = tf.pad(crop, [[0, 1], [0, 1], [0, 0], [0, 0]])
            loss = cross_entropy(tf.nn.convolution(key, kernel, padding="VALID") / CROP**2, place)
        self._apply(1, tape, loss, self.variables)

    def _apply(self, k: int, tape: tf.GradientTape, loss: tf.Tensor, variables: list) -> None:
        gradients = tape.gradient(loss, variables)
        self.optimisers[k].apply_gradients(zip(gradients, variables, strict=True))


def cross_entropy(logits: tf.Tensor, pixel: np.ndarray) -> tf.Tensor:
    """Of a map (1, H, W, 1), and the pixel that is right."""
    label = tf.constant([int(pixel[0]) * SHAPE[1] + int(pixel[1])])
    flat = tf.reshape(logits, (1, -1))
    return tf.reduce_mean(tf.nn.sparse_softmax_cross_entropy_with_logits(label, flat))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--agent", choices=PARAMETERS, default="transporter")
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument(
        "--threads", type=int, default=1, help="0: all processors, the default there"
    )
    options = parser.parse_args()
    tf.config.threading.set_intra_op_parallelism_threads(options.threads)
    tf.config.threading.set_inter_op_parallelism_threads(options.threads)
    original, rng, times = Original(options.agent), np.random.default_rng(0), []
    for _ in range(1 + options.steps):  # the first prepares
        began = time.process_time()
        original.step(rng)
        times.append(time.process_time() - began)
    print(json.dumps({"step_s": times[1:], "parameters": PARAMETERS[options.agent]}))


if __name__ == "__main__":
    main()
