#include "mvs/matching_cost.hpp"

#include <map>
#include <stdexcept>

namespace mvs {
namespace {

std::map<std::string, MakeCost>& registry() {
    static std::map<std::string, MakeCost> costs;
    return costs;
}

}  // namespace

RegisteredCost::RegisteredCost(const char* name, MakeCost make) { registry()[name] = make; }

MakeCost find_cost(const std::string& name) {
    const auto found = registry().find(name);
    if (found != registry().end()) return found->second;
    std::string known;
    for (const auto& [other, make] : registry()) known += (known.empty() ? "" : ", ") + other;
    throw std::invalid_argument("no matching cost '" + name + "'; there are: " + known);
}

}  // namespace mvs
