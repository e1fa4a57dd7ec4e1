"""Names of topics and services, all relative: a team lives in the namespace its nodes are started in.

The topics of observations, actions, joint states and rewards are each group's own; give them through `in_group`.
"""

OBSERVATION = 'robot_{}/observation'
ACTION = 'robot_{}/action'
JOINT_STATE = 'joint_state'
SHARED_REWARD = 'shared_reward'
ROLLOUT_REQUEST = 'rollout_request'
POLICY_UPDATE = 'policy_update'
POLICY = 'policy'
TRAINING_STATUS = 'training_status'
GET_POLICY = 'get_policy'
PAUSE = 'trainer/pause'
RESUME = 'trainer/resume'
SAVE = 'trainer/save'
ODOMETRY = 'robot_{}/odom'
COMMAND = 'robot_{}/cmd_vel'
LANDMARKS = 'landmarks'
CREDIT = 'robot_{}/credit'
MARKERS = 'markers'
TRANSFORMS = '/tf'
CLOCK = '/clock'
NEXT_EPISODE = '~/next_episode'
ACTIVATE_POLICY = '~/activate_policy'
ENABLE = '~/enable'
DIAGNOSTICS = '/diagnostics'
BRIDGE_NODE = 'bridge_{}'


def in_group(topic: str, group: int, world_groups: int) -> str:
    """The topic of one group of worlds; a group that is the only one needs no name."""
    return topic if world_groups == 1 else f'group_{group}/{topic}'


def agent_node(robot: int, group: int, world_groups: int) -> str:
    """The name of a robot's agent among the nodes of a team."""
    return f'agent_{robot}' if world_groups == 1 else f'agent_{group}_{robot}'
