"""The annealed method: tasks, fits, starts and what they agree on, and the whole of it (`method.calibrated`).

Every fit adjusts cameras and trajectories together (`adjustment.solver.adjust`). They differ in where the detections of
a trajectory come from, what they hold, and which loss forgives:

=====================  =====================================  ==========================  ======  =====================
fit                    detections of a trajectory             holds                       loss    called by
=====================  =====================================  ==========================  ======  =====================
``paired_fit``         paired one-camera tracks               the first stage's unknowns  Cauchy  ``starts.run_start``
``tracked_fit``        tracks of the filter, noise inflated   the unknowns of its pass    Cauchy  ``starts.run_start``
``refitted``           chosen anew by the trajectories        nothing, or all values      floor   ``starts``, ``method``
``adjusted_to``        those given                            what the fit given held     floor   the others below
``fit_until``          those until a time                     as the fit given            floor   ``method.history_of``
``restricted_fit``     as the fit given                       unknowns not selected       floor   ``method.selected``
``rescaled``           as the fit given                       as the fit given            floor   ``at_known_scale``
``adjusted_anew``      given first, then chosen anew          nothing                     floor   ``method.believe``
``stated_fit``         chosen anew at its optimum             as the fit given            fixed   ``method.state``
``with_lengths``       as the fit given                       nothing                     fixed   ``method.calibrated``
``with_control``       as the fit given                       nothing                     floor   ``method.calibrated``
=====================  =====================================  ==========================  ======  =====================

``stated_fit`` integrates the trajectories out, with the weights that the floor loss gave at the optimum;
``with_lengths`` adds pairs of objects at a known distance, ``with_control`` a control track of one object. Detections
that share errors count less (`adjustment.shared_errors`) in what is stated, as the residuals there show. The noise of
the motion is what is stated until ``stated_fit`` has found another; the noise of the detections until
``method.believe`` has. A known scale is held by the task, and counts in every fit.
"""
