"""Plans: the cheapest computation of an effect that stays within a tolerance."""
