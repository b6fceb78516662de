"""MuJoCo Warp: many environments of the artefact's scene, stepped together on a GPU."""

from tgdsl.runtime.warp.simulation import WarpSimulation as WarpSimulation
