; Logistics in the spirit of Veloso (1992) and of the planning competition of 1998: trucks drive in
; a city, an aeroplane flies between airports, packages go along. Roads and flights have lengths.
(define (domain logistics)
  (:requirements :strips :typing :equality :negative-preconditions :action-costs)
  (:types
    place package vehicle - object
    airport - place
    truck plane - vehicle)
  (:predicates
    (at ?v - vehicle ?l - place)
    (waits ?p - package ?l - place)
    (in ?p - package ?v - vehicle)
    (road ?from ?to - place)
    (empty ?v - vehicle))
  (:functions
    (total-cost)
    (length ?from ?to - place))

  (:action drive
    :parameters (?v - truck ?from ?to - place)
    :precondition (and (at ?v ?from) (road ?from ?to))
    :effect (and (at ?v ?to) (not (at ?v ?from)) (increase (total-cost) (length ?from ?to))))

  (:action fly
    :parameters (?v - plane ?from ?to - airport)
    :precondition (and (at ?v ?from) (not (= ?from ?to)))
    :effect (and (at ?v ?to) (not (at ?v ?from)) (increase (total-cost) (length ?from ?to))))

  (:action load
    :parameters (?p - package ?v - vehicle ?l - place)
    :precondition (and (at ?v ?l) (waits ?p ?l) (empty ?v))
    :effect (and (in ?p ?v) (not (waits ?p ?l)) (not (empty ?v)) (increase (total-cost) 1)))

  (:action unload
    :parameters (?p - package ?v - vehicle ?l - place)
    :precondition (and (at ?v ?l) (in ?p ?v))
    :effect (and (waits ?p ?l) (empty ?v) (not (in ?p ?v)) (increase (total-cost) 1)))
)
