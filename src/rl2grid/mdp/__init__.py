"""The Markov decision process, written once for every engine."""
