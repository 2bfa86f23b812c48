"""The seven methods of the paper: NN, GPR, QKR, QKR+NN, QKR+GPR, and what they share."""
