-- ================================================================================================
-- rosbayes: bm1_words
-- Stores words from the host, outputs all words that the machine uses, and reports too large words.
-- MIT licence; datasheet: docs/hardware/bm1_words.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;
  use ieee.numeric_std.all;

library work;
  use work.bm1_parameters.all;
  use work.bm1_utilities.all;

entity bm1_words is
  generic (
    DEPTH         : positive;        -- number of words
    USED          : natural;         -- number of words that the machine uses, from word 0 on; at most DEPTH
    WIDTHS        : natural_array_t; -- for each column, the number of used bits in its words, 0 to SLOT_BITS
    PER_COLUMN    : positive;        -- number of successive words for each column
    INITIAL_FILE  : string;          -- MIF of the initial words; if empty, these words are 0
    INITIAL_WORDS : positive;        -- number of words in the MIF; the memory repeats them up to DEPTH
    INITIAL_BITS  : positive         -- width of a word in the MIF
  );
  port (
    clk_i    : in    std_logic;                                       -- clock
    rst_i    : in    std_logic;                                       -- write the initial words
    busy_o   : out   std_logic;                                       -- the initial words are being written
    write_i  : in    std_logic;                                       -- write data_i to word index_i
    index_i  : in    std_logic_vector(bits_for(DEPTH) - 1 downto 0);  -- index of the word to write or read
    data_i   : in    std_logic_vector(31 downto 0);                   -- data to write
    data_o   : out   std_logic_vector(31 downto 0);                   -- word that index_i selected one clock earlier
    values_o : out   std_logic_vector(USED * SLOT_BITS - 1 downto 0); -- used words; word 0 in the lowest bits
    bad_o    : out   std_logic                                        -- a used word has a 1 beyond its used bits
  );
end entity bm1_words;

architecture rtl of bm1_words is

  constant INDEX_BITS           : positive := bits_for(DEPTH);
  constant INITIAL_ADDRESS_BITS : positive := bits_for(INITIAL_WORDS);

  -- a power of two: the index may be an address of another block

  type memory_t is array (0 to 2 ** INDEX_BITS - 1) of std_logic_vector(31 downto 0);

  signal memory        : memory_t;
  signal next_initial  : unsigned(INDEX_BITS downto 0)               := (others => '0');
  signal place         : unsigned(INITIAL_ADDRESS_BITS - 1 downto 0) := (others => '0');
  signal initial_valid : std_logic                                   := '0';
  signal initial_index : unsigned(INDEX_BITS - 1 downto 0)           := (others => '0');
  signal initial_word  : std_logic_vector(31 downto 0)               := (others => '0');
  signal filling       : std_logic;
  signal write         : std_logic;
  signal index         : unsigned(INDEX_BITS - 1 downto 0);
  signal data          : std_logic_vector(31 downto 0);
  signal bad           : std_logic_vector(USED downto 0);

begin

  -- After a reset, write the initial words one by one, as the host would.
  count_initial_words : process (clk_i) is
  begin

    if rising_edge(clk_i) then
      initial_valid <= filling and not rst_i;
      initial_index <= next_initial(INDEX_BITS - 1 downto 0);
      if (rst_i = '1') then
        next_initial <= (others => '0');
        place        <= (others => '0');
      elsif (filling = '1') then
        next_initial <= next_initial + 1;
        if (place = INITIAL_WORDS - 1) then
          place <= (others => '0');
        else
          place <= place + 1;
        end if;
      end if;
    end if;

  end process count_initial_words;

  filling <= '1' when next_initial < DEPTH else
             '0';
  busy_o  <= filling or initial_valid or rst_i;

  initial_memory : if INITIAL_FILE'length > 0 generate

    initial_words_memory : component bm1_table
      generic map (
        file_name    => INITIAL_FILE,
        word_bits    => INITIAL_BITS,
        depth        => INITIAL_WORDS,
        address_bits => INITIAL_ADDRESS_BITS,
        first_bit    => 0,
        data_bits    => INITIAL_BITS
      )
      port map (
        clk_i     => clk_i,
        enable_i  => filling,
        address_i => std_logic_vector(place),
        data_o    => initial_word(INITIAL_BITS - 1 downto 0)
      );

  end generate initial_memory;

  write <= write_i or initial_valid;
  index <= initial_index when initial_valid = '1' else
           unsigned(index_i);
  data  <= initial_word when initial_valid = '1' else
           data_i;

  access_memory : process (clk_i) is
  begin

    if rising_edge(clk_i) then
      if (write = '1') then
        memory(to_integer(index)) <= data;
      end if;
      data_o <= memory(to_integer(index));
    end if;

  end process access_memory;

  each_word : for w in 0 to USED - 1 generate

    constant WIDTH : natural := WIDTHS(WIDTHS'left + (w / PER_COLUMN) mod WIDTHS'length);

    signal too_large : std_logic := '0';

  begin

    visible : if WIDTH > 0 generate

      signal value : std_logic_vector(WIDTH - 1 downto 0) := (others => '0');

    begin

      hold_word : process (clk_i) is
      begin

        if rising_edge(clk_i) then
          if (write = '1' and index = w) then
            value <= data(WIDTH - 1 downto 0);
          end if;
        end if;

      end process hold_word;

      values_o(w * SLOT_BITS + WIDTH - 1 downto w * SLOT_BITS) <= value;
    end generate visible;

    unused_bits : if WIDTH < SLOT_BITS generate
      values_o((w + 1) * SLOT_BITS - 1 downto w * SLOT_BITS + WIDTH) <= (others => '0');
    end generate unused_bits;

    check_word : process (clk_i) is
    begin

      if rising_edge(clk_i) then
        if (write = '1' and index = w) then
          too_large <= or data(31 downto WIDTH);
        end if;
      end if;

    end process check_word;

    bad(w) <= too_large;
  end generate each_word;

  bad(USED) <= '0';
  bad_o     <= or bad;

end architecture rtl;
