"""The simulators that play the decision process."""
