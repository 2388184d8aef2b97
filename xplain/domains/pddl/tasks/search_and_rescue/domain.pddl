; Urban search and rescue, in the spirit of the scenario of the model-reconciliation papers
; (Chakraborti, Sreedharan, Zhang & Kambhampati 2017; Sreedharan, Chakraborti & Kambhampati 2018): a
; robot goes through a damaged building, whose commander outside has an old map.
(define (domain search-and-rescue)
  (:requirements :strips :typing :negative-preconditions :conditional-effects :action-costs)
  (:types room)
  (:constants entrance - room)
  (:predicates
    (at ?r - room)
    (door ?from ?to - room)
    (blocked ?from ?to - room)
    (rubble ?from ?to - room)
    (smoke ?r - room)
    (victim ?r - room)
    (medkit ?r - room)
    (have-medkit)
    (treated)
    (carrying)
    (safe))
  (:functions (total-cost))

  (:action go
    :parameters (?from ?to - room)
    :precondition (and (at ?from) (door ?from ?to) (not (blocked ?from ?to)) (not (smoke ?to)))
    :effect (and (at ?to) (not (at ?from)) (increase (total-cost) 1)))

  (:action go-through-smoke
    :parameters (?from ?to - room)
    :precondition (and (at ?from) (door ?from ?to) (not (blocked ?from ?to)) (smoke ?to))
    :effect (and (at ?to) (not (at ?from)) (increase (total-cost) 2)))

  (:action climb-over
    :parameters (?from ?to - room)
    :precondition (and (at ?from) (rubble ?from ?to) (not (carrying)))
    :effect (and (at ?to) (not (at ?from)) (increase (total-cost) 1)))

  (:action clear
    :parameters (?from ?to - room)
    :precondition (and (at ?from) (door ?from ?to) (blocked ?from ?to))
    :effect (and (not (blocked ?from ?to)) (not (blocked ?to ?from)) (increase (total-cost) 3)))

  (:action take-medkit
    :parameters (?r - room)
    :precondition (and (at ?r) (medkit ?r))
    :effect (and (have-medkit) (not (medkit ?r)) (increase (total-cost) 1)))

  (:action treat
    :parameters (?r - room)
    :precondition (and (at ?r) (victim ?r) (have-medkit))
    :effect (and (treated) (not (have-medkit)) (increase (total-cost) 1)))

  (:action lift
    :parameters (?r - room)
    :precondition (and (at ?r) (victim ?r) (treated))
    :effect (and (carrying) (not (victim ?r)) (increase (total-cost) 1)))

  (:action hand-over
    :parameters ()
    :precondition (and (at entrance) (carrying))
    :effect (and (safe) (not (carrying)) (increase (total-cost) 1)))
)
