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
``fit_until``          those until a time                     as the fit given            floor   ``fits.history_of``
``rescaled``           as the fit given                       as the fit given            floor   ``at_known_scale``
``readjusted``         as the fit given                       nothing, or all values      floor   ``method.believe``
``with_freed``         as the fit given                       all values                  floor   ``method.believe``
``marginal_fit``       as the fit given                       nothing                     fixed   ``method.believe``
``restated_fit``       chosen anew at a marginal optimum      nothing                     fixed   ``method.believe``
``with_lengths``       as the fit given                       nothing                     fixed   ``method.calibrated``
``with_control``       as the fit given                       nothing                     floor   ``method.calibrated``
=====================  =====================================  ==========================  ======  =====================

``marginal_fit`` integrates the trajectories out, with the weights that the floor loss gave at the optimum;
``with_lengths`` adds pairs of objects at a known distance, ``with_control`` a control track of one object. The noise of
the motion is what is stated until ``marginal_fit`` has found another; the noise of the detections, and how much of it
they share (`adjustment.noise`), until ``method.believe`` has. Detections that share errors count less from then on. A
known scale is held by the task, and counts in every fit.
"""
