; Two cities, a truck in each, one plane; the parcel goes across, the letter to the airport.
(define (problem two-cities)
  (:domain logistics)
  (:objects
    office market - place
    north south - airport
    harbour - place
    truck1 truck2 - truck
    plane - plane
    parcel letter - package)
  (:init
    (at truck1 office) (at truck2 harbour) (at plane south)
    (empty truck1) (empty truck2) (empty plane)
    (waits parcel office) (waits letter market)
    (road office market) (road market office)
    (road market north) (road north market)
    (road office north) (road north office)
    (road south harbour) (road harbour south)
    (= (length office market) 2) (= (length market office) 2)
    (= (length market north) 2) (= (length north market) 2)
    (= (length office north) 5) (= (length north office) 5)
    (= (length south harbour) 3) (= (length harbour south) 3)
    (= (length north south) 6) (= (length south north) 6)
    (= (total-cost) 0))
  (:goal (and (waits parcel harbour) (waits letter north)))
  (:metric minimize (total-cost)))
