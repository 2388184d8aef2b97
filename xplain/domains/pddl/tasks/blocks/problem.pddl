; Turn a tower of three, and put the fourth block on top.
(define (problem tower)
  (:domain blocks)
  (:objects a b c d - block)
  (:init
    (ontable a) (on b a) (on c b) (clear c)
    (ontable d) (clear d)
    (handempty)
    (= (total-cost) 0))
  (:goal (and (on a b) (on b c) (on d a)))
  (:metric minimize (total-cost)))
