"""LoopSplat's registration in both directions."""

from __future__ import annotations

from registered_room import Scene, error, motion

from benchmarks.loops.two_way_registration import TwoWayRegistration
from toolkit.slam.loops.registration.fine import FineRegistration
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.loops.registration.sgr import SemanticGuidedRegistration


def test_two_ways_lead_to_the_same_place(room: Scene, renderer):
    registrar = TwoWayRegistration(FineRegistration(RegistrationOptions(views=2), renderer))
    start = room.T_target_source @ motion(1, 0.05, 3.0)
    result = registrar.register(room.target, room.source, start)
    mm, deg = error(result.T_target_source, room.T_target_source)
    assert result.converged, result.reason
    assert mm < 3.0
    assert deg < 0.1
    assert result.renders == renderer.renders
    # Two views each way, all of which agree: four hypotheses of 3 cm.
    assert result.information[0, 0] > 3.5 / 0.03**2


def test_two_ways_after_the_coarse_stage_need_no_start(room: Scene, renderer):
    options = RegistrationOptions(views=2)
    refiner = TwoWayRegistration(FineRegistration(options, renderer))
    registrar = SemanticGuidedRegistration(options, renderer, refiner=refiner)
    result = registrar.register(room.target, room.source)
    assert result.converged, result.reason
    assert error(result.T_target_source, room.T_target_source)[0] < 3.0
    assert result.method == "coarse, two-way"
