"""The annealed method: tasks, fits, starts and what they agree on, and the whole of it (`method.calibrated`).

Fits differ in where the detections of a trajectory come from, what they hold, and which loss forgives. Those of passes
adjust cameras and trajectories together (`adjustment.solver.adjust`), and are confirmed by the marginal posterior
(`fits.confirmed_fit`). Those to given detections integrate the trajectories out (`adjustment.marginal`), but where they
hold all values:

=====================  =====================================  ==========================  ======  =====================
fit                    detections of a trajectory             holds                       loss    called by
=====================  =====================================  ==========================  ======  =====================
``paired_fit``         paired one-camera tracks               nothing                     Cauchy  ``starts.run_start``
``tracked_fit``        tracks of the filter, noise inflated   nothing                     Cauchy  ``starts.run_start``
``refitted``           chosen anew by the trajectories        nothing, or all values      fixed   ``starts``, ``method``
``adjusted_to``        those given                            what the fit given held     fixed   the others below
``rescaled``           as the fit given                       as the fit given            fixed   ``at_known_scale``
``readjusted``         as the fit given                       nothing, or all values      fixed   ``method.believe``
``with_freed``         as the fit given                       all values                  floor   ``method.believe``
``marginal_fit``       as the fit given                       nothing                     fixed   ``method.believe``
``with_lengths``       as the fit given                       nothing                     fixed   ``method.calibrated``
``with_control``       as the fit given                       nothing                     floor   ``method.calibrated``
=====================  =====================================  ==========================  ======  =====================

``fixed`` are the weights that the floor loss gives where a search begins, and again at the optimum. ``marginal_fit``
searches to the end; ``with_lengths`` adds pairs of objects at a known distance, ``with_control`` a control track of one
object. The noise of the motion goes on from fit to fit; that of the detections, and how much of it they share
(`adjustment.noise`), is what is stated until ``method.believe`` has found another. Detections that share errors count
less from then on. A known scale is held by the task, and counts in every fit.
"""
