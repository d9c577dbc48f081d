"""Commands of the verbs that are not made from requests yet."""
