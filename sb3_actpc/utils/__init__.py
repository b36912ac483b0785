"""Parts shared by the agents, the environments and the commands."""
