"""Controls a running node over the graph: services and parameters."""

from __future__ import annotations

from typing import Any

from graph import Graph
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from std_srvs.srv import Trigger


class Control:
    def __init__(self, graph: Graph, node: str = '/splatam') -> None:
        self._graph = graph
        self._node = node
        self._parameters = AsyncParameterClient(graph.node, node)
        self._clients: dict[str, Any] = {}

    def call(self, service: str) -> Trigger.Response:
        client = self._clients.get(service)
        if client is None:
            client = self._clients[service] = self._graph.node.create_client(Trigger, f'{self._node}/{service}')
            self._graph.spin_until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        self._graph.spin_until(future.done)
        return future.result()

    def succeed(self, service: str) -> str:
        response = self.call(service)
        assert response.success, response.message
        return response.message

    def fail(self, service: str) -> str:
        response = self.call(service)
        assert not response.success, response.message
        return response.message

    def set(self, **values: Any) -> list[SetParametersResult]:
        """Set parameters; returns one result per parameter. ``a__b`` stands for ``a.b``."""
        self._graph.spin_until(self._parameters.services_are_ready)
        changes = [Parameter(name.replace('__', '.'), value=value) for name, value in values.items()]
        future = self._parameters.set_parameters(changes)
        self._graph.spin_until(future.done)
        return future.result().results

    def change(self, **values: Any) -> None:
        for result in self.set(**values):
            assert result.successful, result.reason
