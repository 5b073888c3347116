"""Defaults that commands, nodes and Python calls share; imports nothing, so `--help` is quick."""

from typing import Final

# training and environments
TASK: Final = "navigation"
WORLD: Final = "arena"  # for environments, nodes and the demo
EPISODE_STEPS: Final = 300  # time limit of an episode
# The fast simulator reads ranges from the lookup table; policies were trained with it.
RENDERER: Final = "baked"
# MuJoCo, the reference to compare with, computes every ray.
MUJOCO_RENDERER: Final = "exact"

# evaluation
EVALUATION_WORLD: Final = "circles"
EVALUATION_EPISODES: Final = 20  # per place
EVALUATION_SEED: Final = 1_000_000  # first episode; far from training seeds
DEMO_EPISODES: Final = 5  # number in process, and over DDS
SHADOW_AHEAD_S: Final = 4.0  # default goal: the robot's position this much later
CONFIRMED_BEYOND_M: Final = 5.0  # farther goals of a vehicle need confirmation
VEHICLE_START: Final = "wait"  # until it is at the start; alternative: `present`

# safety evidence: this many episodes without a failure bound its rate by 1e-4
ASSURANCE_EPISODES: Final = 30_000
ASSURANCE_FAULTS: Final = 1_000  # injected over DDS
ASSURANCE_WORLDS: Final = ("arena", "clutter", "crowd")
ASSURANCE_RANDOMISATION: Final = "mild"

# importing worlds
IMPORT_CLEARANCE_M: Final = (
    0.1  # around the footprint: imported worlds are often narrow
)
IMPORT_GOAL_DISTANCE_M: Final = 2.0  # minimum distance from start to goal

# recording and identification
DRIVE_S: Final = 60.0  # duration of an identification drive
DRIVE_BOUND_M: Final = (
    2.0  # radius of the circle around the start in which the robot stays
)
BAG_STORAGE: Final = "mcap"
TAYLOR_ORDER: Final = "auto"  # order of Eq. 1 that predicts best
PRUNING: Final = "auto"  # alpha of Eq. 2 at the knee of the accuracy

# a robot behind its topics
SIMULATOR_NODE: Final = "simulator_node"
ANSWER_S: Final = 30.0  # longest wait for a peer or an answer
COMMAND_SILENCE_S: Final = 0.5  # a robot without new commands stops after this time
DATA_SILENCE_S: Final = 0.5  # a driver without new data stops the robot after this time
LISTEN_S: Final = 5.0  # to check a robot against a model
IMU_TOPIC: Final = "auto"  # `imu` or `imu/data`, if the model was made with a gyro
POSE_TYPE: Final = "none"  # no pose sensor

# the page of nics watch
PAGE_PORT: Final = 8765
