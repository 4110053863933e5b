"""The survey against a vehicle on PX4's ports: `mavsitl vehicle` in one terminal, this in another."""

from wind_hold.survey import Survey

with Survey("udpin://127.0.0.1:14540") as survey:
    print("reached", survey.fly([(3.0, 0.0), (3.0, 3.0)]), "and landed")
