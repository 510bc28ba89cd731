"""What small networks compute, in compiled code: the same bits on every processor, whatever the batch and the threads.

:mod:`rl2grid.dense.tiles` multiplies a tile of two matrices in registers, :mod:`rl2grid.dense.layers` computes layers
and their gradients with it, :mod:`rl2grid.dense.perceptron` several of them in a row, :mod:`rl2grid.dense.choices`
probabilities of actions. :mod:`rl2grid.dense.surrogate` and :mod:`rl2grid.dense.adam` make a whole step of PPO.
"""
