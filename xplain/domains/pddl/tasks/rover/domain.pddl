; A rover far away, in the spirit of the rovers domain of the planning competition of 2002: it
; drives between waypoints, samples rock, takes a picture, and sends what it has found.
(define (domain rover)
  (:requirements :strips :typing :negative-preconditions :conditional-effects :action-costs)
  (:types waypoint)
  (:predicates
    (at ?w - waypoint)
    (way ?from ?to - waypoint)
    (steep ?from ?to - waypoint)
    (rock ?w - waypoint)
    (view ?w - waypoint)
    (sees-base ?w - waypoint)
    (sunny ?w - waypoint)
    (charged)
    (dusty)
    (full)
    (have-rock)
    (have-picture)
    (sent-rock)
    (sent-picture))
  (:functions (total-cost))

  (:action drive
    :parameters (?from ?to - waypoint)
    :precondition (and (at ?from) (way ?from ?to))
    :effect (and (at ?to) (not (at ?from)) (increase (total-cost) 2)))

  (:action climb
    :parameters (?from ?to - waypoint)
    :precondition (and (at ?from) (steep ?from ?to) (charged))
    :effect (and (at ?to) (not (at ?from)) (not (charged)) (increase (total-cost) 3)))

  (:action charge
    :parameters (?w - waypoint)
    :precondition (and (at ?w) (sunny ?w) (not (charged)))
    :effect (and (charged) (increase (total-cost) 2)))

  (:action sample
    :parameters (?w - waypoint)
    :precondition (and (at ?w) (rock ?w) (not (full)))
    :effect (and (have-rock) (full) (dusty) (increase (total-cost) 2)))

  (:action clean
    :parameters ()
    :precondition (and (dusty))
    :effect (and (not (dusty)) (increase (total-cost) 1)))

  (:action photograph
    :parameters (?w - waypoint)
    :precondition (and (at ?w) (view ?w) (not (dusty)))
    :effect (and (have-picture) (increase (total-cost) 1)))

  (:action send
    :parameters (?w - waypoint)
    :precondition (and (at ?w) (sees-base ?w))
    :effect (and (when (have-rock) (sent-rock)) (when (have-picture) (sent-picture))
                 (increase (total-cost) 4)))
)
