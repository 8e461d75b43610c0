"""Networks: Transporters and their goal-conditioned variants, and the ground-truth baselines.

Every class has one import path, its own module: `transporter` (agents over images), `traced` (an
agent over the cable that two masks show), `gt_state` (agents over state vectors), and below them
`attention`, `transport`, `lift`, `resnet` and `cable_model`.
"""

__all__: list[str] = []
