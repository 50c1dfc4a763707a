"""What to take: the start law and the γ of a coupling (`start_law`), the proposal of each interval
(`choose_proposal`), and the setting that is cheapest for an accuracy (`work_precision`, whose
results are `settings`). `hitting_variation` tells what makes weights unequal: how much the
probability varies that a bridge is hit.
"""
