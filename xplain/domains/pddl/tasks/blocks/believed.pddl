; What somebody believes of the blocks world: the robot has two hands, and the table is far away.
(define (domain blocks)
  (:requirements :strips :typing :action-costs)
  (:types block)
  (:predicates
    (on ?x - block ?y - block)
    (ontable ?x - block)
    (clear ?x - block)
    (holding ?x - block)
    (handempty))
  (:functions (total-cost))

  (:action pick-up
    :parameters (?x - block)
    :precondition (and (clear ?x) (ontable ?x))
    :effect (and (holding ?x) (not (ontable ?x)) (not (clear ?x)) (not (handempty))
                 (increase (total-cost) 1)))

  (:action put-down
    :parameters (?x - block)
    :precondition (and (holding ?x))
    :effect (and (ontable ?x) (clear ?x) (handempty) (not (holding ?x))
                 (increase (total-cost) 3)))

  (:action stack
    :parameters (?x - block ?y - block)
    :precondition (and (holding ?x) (clear ?y))
    :effect (and (on ?x ?y) (clear ?x) (handempty) (not (holding ?x)) (not (clear ?y))
                 (increase (total-cost) 1)))

  (:action unstack
    :parameters (?x - block ?y - block)
    :precondition (and (on ?x ?y) (clear ?x) (handempty))
    :effect (and (holding ?x) (clear ?y) (not (on ?x ?y)) (not (clear ?x)) (not (handempty))
                 (increase (total-cost) 1)))
)
