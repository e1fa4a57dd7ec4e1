"""parameter_server: keeps the policy's versions on disk and hands the newest to the agents.

    ros2 run dae_ros parameter_server --ros-args -p policies_folder:=runs/policies
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import BinaryIO

from dae_ros_msgs import msg, srv

from dae_ros.config import ParameterServerSettings, RunBinding, TeamKey, declarations
from dae_ros.errors import Refused, RunFolderError
from dae_ros.files import hold
from dae_ros.rollout.lockstep import check_run
from dae_ros.ros import convert, names, qos
from dae_ros.ros.node import TeamNode, is_over, run
from dae_ros.ros.trust import team_key
from dae_ros.types import PolicyWeights
from dae_ros.weights.codec import open_weights, seal
from dae_ros.weights.store import PolicyStore

NEWEST = 2**64 - 1


class ParameterServerNode(TeamNode):
    """Serves a `PolicyStore`; one folder for each run."""

    def __init__(self):
        super().__init__('parameter_server', declarations(ParameterServerSettings, RunBinding, TeamKey))
        self._key = team_key(self, self.settings['key_file'])
        self._run = self.settings['run']
        self._bound = self._run != 0
        self._store: PolicyStore | None = None
        self._claim: BinaryIO | None = None  # to its folder
        self._version: int | None = None
        self._policy = self.publisher(msg.PolicyWeights, names.POLICY, qos.LATCHED)
        if self._bound:
            self._open_store()
        self.listen(msg.PolicyWeights, names.POLICY_UPDATE, qos.LATCHED_INPUT, self._on_update)
        self.listen(msg.TrainingStatus, names.TRAINING_STATUS, qos.LATCHED_INPUT, self._on_status)
        self.create_service(srv.GetPolicy, names.GET_POLICY, self._on_get_policy)

    def _open_store(self) -> None:
        """Opens the run's folder and serves its newest version."""
        folder = Path(self.settings['policies_folder']) / f'{self._run:016x}'
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            self._claim = hold(folder.with_suffix('.lock'))
            if self._claim is None:
                raise RunFolderError(f'another parameter server is at work in {folder}; stop it or choose another folder')
            self._store = PolicyStore(folder, self.settings['keep_policies'])
        except OSError as error:
            raise RunFolderError(f'cannot write the policies to {folder}: {error.strerror}') from error
        newest = self._store.newest()
        if newest is not None:
            self._publish(seal(self._run, *newest, self._key))

    def _publish(self, weights: PolicyWeights) -> None:
        self._version = weights.version
        self._policy.publish(convert.policy_weights_message(weights))

    def _on_update(self, message: msg.PolicyWeights) -> None:
        weights = convert.policy_weights(message)
        check_run(weights.run, self._run)
        open_weights(weights, self._key)
        if self._store is None:
            self._run = weights.run
            self._open_store()
        if weights.version == self._version:
            raise Refused(Refused.DUPLICATE, f'policy version {weights.version}')
        self._store.save(weights.version, weights.data)
        self._publish(weights)

    def _on_get_policy(self, request: srv.GetPolicy.Request, response: srv.GetPolicy.Response) -> srv.GetPolicy.Response:
        version = self._version if request.version == NEWEST else request.version
        data = None if self._store is None or version is None else self._store.load(version)
        if data is None:
            response.message = 'there is no policy yet' if self._version is None else f'policy version {version} is not kept'
            return response
        response.success = True
        response.policy = convert.policy_weights_message(seal(self._run, version, data, self._key))
        return response

    def _on_status(self, message: msg.TrainingStatus) -> None:
        """A server that joined the run it heard takes the next one's policies when that run is over."""
        if is_over(message) and message.run == self._run and not self._bound:
            self._run, self._store, self._version = 0, None, None
            self._claim.close()

    def diagnose(self):
        sentence = 'waiting for a policy' if self._version is None else f'serving policy version {self._version}'
        return sentence, {'run': f'{self._run:x}', 'agents': self._policy.get_subscription_count()}


def main(args: list[str] | None = None) -> int:
    return run(ParameterServerNode, args)


if __name__ == '__main__':
    sys.exit(main())
