"""Policy files: contract, graph, and how they are opened and run."""
