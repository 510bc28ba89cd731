"""The reference engine: Grid2Op with the LightSim2Grid power flow."""
