"""The recipe's section `model`: the light path and effects that stages fit."""
