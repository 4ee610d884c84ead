-- ================================================================================================
-- rosbayes: bm1_readout
-- Selects the result that the host reads: a counter, or a word of a replica's outcome.
-- MIT licence; datasheet: docs/hardware/bm1_readout.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;
  use ieee.numeric_std.all;

entity bm1_readout is
  generic (
    RESULTS      : positive; -- number of counters, all replicas together
    COUNTER_BITS : positive; -- width of a counter
    REPLICAS     : positive  -- number of replicas (machines that share the generators)
  );
  port (
    clk_i     : in    std_logic;                                             -- clock
    index_i   : in    std_logic_vector(11 downto 0);                         -- index of a counter, or of a word of OUTCOMES (10 bits)
    counts_i  : in    std_logic_vector(RESULTS * COUNTER_BITS - 1 downto 0); -- counters; counter 0 in the lowest bits
    reasons_i : in    std_logic_vector(3 * REPLICAS - 1 downto 0);           -- stop reasons of the replicas
    cycles_i  : in    std_logic_vector(64 * REPLICAS - 1 downto 0);          -- numbers of cycles of the replicas
    result_o  : out   std_logic_vector(31 downto 0);                         -- counter that index_i selected one clock earlier
    outcome_o : out   std_logic_vector(31 downto 0)                          -- word of OUTCOMES that index_i selected one clock earlier
  );
end entity bm1_readout;

architecture rtl of bm1_readout is

  type counts_t is array (0 to RESULTS - 1) of std_logic_vector(COUNTER_BITS - 1 downto 0);

  type words_t is array (0 to 4 * REPLICAS - 1) of std_logic_vector(31 downto 0);

  signal counts : counts_t;

begin

  each_count : for c in 0 to RESULTS - 1 generate
    counts(c) <= counts_i((c + 1) * COUNTER_BITS - 1 downto c * COUNTER_BITS);
  end generate each_count;

  select_count : process (clk_i) is
  begin

    if rising_edge(clk_i) then
      result_o <= (others => '0');
      if (unsigned(index_i) < RESULTS) then
        result_o(COUNTER_BITS - 1 downto 0) <= counts(to_integer(unsigned(index_i)));
      end if;
    end if;

  end process select_count;

  outcomes : if REPLICAS > 1 generate

    signal words : words_t;

  begin

    each_replica : for r in 0 to REPLICAS - 1 generate
      words(4 * r)     <= (31 downto 3 => '0') & reasons_i(3 * r + 2 downto 3 * r);
      words(4 * r + 1) <= (others => '0');
      words(4 * r + 2) <= cycles_i(64 * r + 31 downto 64 * r);
      words(4 * r + 3) <= cycles_i(64 * r + 63 downto 64 * r + 32);
    end generate each_replica;

    select_word : process (clk_i) is
    begin

      if rising_edge(clk_i) then
        outcome_o <= (others => '0');
        if (unsigned(index_i(9 downto 0)) < 4 * REPLICAS) then
          outcome_o <= words(to_integer(unsigned(index_i(9 downto 0))));
        end if;
      end if;

    end process select_word;

  else generate
    outcome_o <= (others => '0');
  end generate outcomes;

end architecture rtl;
