"""Defaults that commands, nodes and Python calls share; imports nothing, so `--help` is quick."""

from typing import Final

# training and environments
TASK: Final = "navigation"
WORLD: Final = "arena"  # of environments and nodes, and of the demo's whole chain
EPISODE_STEPS: Final = 300  # time limit of an episode
# of the lookup table, in the fast simulator; policies were trained and measured with it
RENDERER: Final = "baked"
# of every ray, in MuJoCo, which is there to be compared with
MUJOCO_RENDERER: Final = "exact"

# evaluation
EVALUATION_WORLD: Final = "circles"
EVALUATION_EPISODES: Final = 20  # in each place
EVALUATION_SEED: Final = 1_000_000  # of the first episode, far from those of a training
DEMO_EPISODES: Final = 5  # in process, and again over DDS
SHADOW_AHEAD_S: Final = 4.0  # without a goal, it is where the robot is this much later
CONFIRMED_BEYOND_M: Final = (
    5.0  # a goal that is farther away from a vehicle is confirmed
)
VEHICLE_START: Final = "wait"  # until it stands at the start; or `present`

# recording and identification
DRIVE_S: Final = 60.0  # duration of a drive to learn from
DRIVE_BOUND_M: Final = 2.0  # radius of the circle around the start that holds the robot
BAG_STORAGE: Final = "mcap"
TAYLOR_ORDER: Final = "auto"  # of Eq. 1: the one that predicts best
PRUNING: Final = "auto"  # alpha of Eq. 2: the knee of the accuracy

# a robot behind its topics
SIMULATOR_NODE: Final = "simulator_node"
ANSWER_S: Final = 30.0  # longest wait for a peer or an answer
LISTEN_S: Final = 5.0  # to a robot, to check it against a model
IMU_TOPIC: Final = "auto"  # `imu` or `imu/data`, if the model was made with a gyro
POSE_TYPE: Final = "none"  # no pose sensor
