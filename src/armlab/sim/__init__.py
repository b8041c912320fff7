"""The simulated arm and its controller: the only place that knows a truth. Everything else sees what came over the wire."""

__all__: list[str] = []
